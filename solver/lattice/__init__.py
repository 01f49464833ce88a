"""Square and cubic lattices: shape functions are products of one function per axis, and sums go axis by axis.

`axis` has the functions of one axis, `windows` where each field lives, `loops` the sums over points, `scheme` the
rates of change. Nothing here knows of meshes, slots or tables of neighbours.
"""
