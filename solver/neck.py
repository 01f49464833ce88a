"""The neck between two particles: the part of the surface eta_1 = eta_2 that lies inside the solid, rho > 0.5."""

import numpy as np
from scipy.spatial import cKDTree

from . import field
from .arrays import Floats
from .case import Case
from .geometry import Mesh, lattice
from .neighbours import make_grid
from .points import on_mesh

NET = {2: 0.5, 3: 0.75}  # widths: spacing of the lattice on which a neck is measured where the nodes are none

# Where eta_1 = eta_2 crosses a cell's edges, by the number of its corners (in falling order) with eta_1 > eta_2.
SECTIONS = {
    (2, 1): ((0, 1), (0, 2)),
    (2, 2): ((0, 2), (1, 2)),
    (3, 1): ((0, 1), (0, 2), (0, 3)),
    (3, 2): ((0, 2), (0, 3), (1, 3), (1, 2)),
    (3, 3): ((0, 3), (1, 3), (2, 3)),
}


class Neck:
    """Measures the neck on the whole mesh; used on rank 0 alone."""

    def __init__(self, case: Case, mesh: Mesh) -> None:
        self.case, self.mesh = case, mesh
        self.grid = make_grid(mesh.nodes, 2.0 * mesh.width)
        self.net, self.nearest = mesh, np.arange(len(mesh.nodes))
        if not on_mesh(case):
            self.net = lattice(case.domain.size, NET[case.dim] * mesh.width)
            self.nearest = np.asarray(cKDTree(mesh.nodes).query(self.net.nodes)[1])

    def measure(self, fields: Floats) -> float:
        """Length in nm (2-D) or area in nm^2 (3-D); fields (n, 3) are the coefficients of rho, eta_1, eta_2.

        The fields u(x) = sum_a N_a(x) u_a are evaluated at the corners of the cells in the contact and are linear in
        between. The cells are the mesh's where it is a lattice or its functions are linear, else those of a lattice.
        """
        corner = fields[self.nearest[self.net.cells]]
        high = corner.max(axis=1)
        cells = self.net.cells[(high[:, 0] > 0.2) & (high[:, 1] > 0.01) & (high[:, 2] > 0.01)]
        numbers, places = np.unique(cells, return_inverse=True)
        if on_mesh(self.case):
            u = field.at_nodes(self.case, self.mesh, numbers, fields, self.grid)
        else:
            u = field.at(self.case, self.mesh, self.net.nodes[numbers], fields, self.grid)
        return section(self.net.nodes[cells], u[places.reshape(cells.shape)])


def section(corners: Floats, u: Floats) -> float:
    """Measure of {u_1 = u_2, u_0 > 1/2} in simplices with linear fields.

    corners (c, dim + 1, dim), u (c, dim + 1, 3).
    """
    dim = corners.shape[2]
    gap = u[:, :, 1] - u[:, :, 2]
    order = np.argsort(-gap, axis=1)
    gap = np.take_along_axis(gap, order, axis=1)
    x = np.take_along_axis(corners, order[:, :, None], axis=1)
    solid = np.take_along_axis(u[:, :, 0], order, axis=1) - 0.5
    positive = (gap > 0.0).sum(axis=1)
    total = 0.0
    for count in range(1, dim + 1):
        chosen = positive == count
        edges = np.array(SECTIONS[dim, count])
        above, below = gap[chosen][:, edges[:, 0]], gap[chosen][:, edges[:, 1]]
        t = above / (above - below)
        points = x[chosen][:, edges[:, 0]] * (1.0 - t[:, :, None]) + x[chosen][:, edges[:, 1]] * t[:, :, None]
        f = solid[chosen][:, edges[:, 0]] * (1.0 - t) + solid[chosen][:, edges[:, 1]] * t
        for k in range(1, len(edges) - dim + 2):
            piece = [0, 1] if dim == 2 else [0, k, k + 1]
            total += float((extent(points[:, piece]) * positive_part(f[:, piece])).sum())
    return total


def extent(points: Floats) -> Floats:
    """Length of segments (c, 2, 2) or area of triangles (c, 3, 3)."""
    if points.shape[1] == 2:
        return np.asarray(np.linalg.norm(points[:, 1] - points[:, 0], axis=1))
    normals = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    return np.asarray(0.5 * np.linalg.norm(normals, axis=1))


def positive_part(f: Floats) -> Floats:
    """The fraction of a segment (c, 2) or triangle (c, 3) where the linear f is positive."""
    f = -np.sort(-f, axis=1)
    count = (f > 0.0).sum(axis=1)
    part = np.where(count == f.shape[1], 1.0, 0.0)
    one = count == 1
    if f.shape[1] == 2:
        part[one] = f[one, 0] / (f[one, 0] - f[one, 1])
        return part
    part[one] = f[one, 0] ** 2 / ((f[one, 0] - f[one, 1]) * (f[one, 0] - f[one, 2]))
    two = count == 2
    part[two] = 1.0 - f[two, 2] ** 2 / ((f[two, 0] - f[two, 2]) * (f[two, 1] - f[two, 2]))
    return part
