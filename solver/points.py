"""Material points of their own: a regular lattice over the domain, whatever the nodes; and one width for all functions.

The points only integrate (Huang et al. 2023, equations 17-29). On a lattice of their own they do so however badly the
nodes lie: what remains of a mesh are its nodes, and cells for pictures. One width for all functions, chosen by the
largest gap between nodes, lets no function jump where nodes crowd.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from .amounts import POINTS
from .arrays import Floats
from .case import LATTICES, Case
from .geometry import Mesh, MeshError, along_curve

WIDTH = {2: 1.1, 3: 1.15}  # of the functions on even nodes, in mean distances of these: a spacing of good meshes
EVEN = {2: 0.8, 3: 1.1}  # radius of the largest gap, in the same unit, up to which nodes count as even
WIDEST = 1.3  # width on uneven ones, in widths of the interface, which wider functions do not hold,
MOST, NARROWEST = 2.0, 0.9  # but at most and at least in radii of the gap
PITCH = 1 / POINTS  # the default pitch of the points, in mean distances of nodes
LIKELY = 50  # places at which the largest gap is looked for more closely
PROBES = 3.0  # places per mean distance of nodes, along each axis, at which gaps are looked for


def on_mesh(case: Case) -> bool:
    """Whether measuring can rely on the mesh: a lattice, or linear functions, which are nothing without their cells."""
    return case.nodes.source in LATTICES or case.shape_functions.kind == "linear"


def with_points(case: Case, mesh: Mesh) -> Mesh:
    """The mesh with the points and the width that the case asks for."""
    given, size = case.shape_functions, case.domain.size
    if given.kind == "linear":
        return mesh
    if case.nodes.source in LATTICES:
        return mesh if given.width is None else replace(mesh, width=given.width)
    width = width_for(case, mesh)
    if case.points.source == "cells":
        return replace(mesh, width=width)
    pitch = PITCH * mean_distance(mesh.nodes, size) if case.points.pitch is None else case.points.pitch
    if pitch > width:
        raise MeshError(f"points.pitch = {pitch:g}: must be at most the width of the shape functions, {width:.4g}")
    points, weights = regular(size, pitch)
    return replace(
        mesh, points=points, weights=weights, spacing=np.full(len(points), width), width=width, in_cells=False
    )


def width_for(case: Case, mesh: Mesh) -> float:
    """The width of the functions on nodes that are no lattice; `MeshError` where a given one leaves a gap open."""
    given, size = case.shape_functions.width, case.domain.size
    gap, middle = largest_gap(mesh.nodes, size)
    if given is None:
        distance = mean_distance(mesh.nodes, size)
        if gap <= EVEN[case.dim] * distance:
            return WIDTH[case.dim] * distance
        wide = min(WIDEST * case.particles.interface_width, MOST * gap)
        return max(wide, WIDTH[case.dim] * distance, NARROWEST * gap)
    if given < NARROWEST * gap:
        place = ", ".join(f"{x:.6g}" for x in middle)
        raise MeshError(
            f"shape_functions.width = {given:g}: too narrow for the gap around ({place}) nm, whose nearest node is "
            f"{gap:.4g} nm away: at least {NARROWEST * gap:.4g} is needed, or nodes in the gap"
        )
    return given


def remarks(case: Case, mesh: Mesh) -> list[str]:
    """What a user should know of the width before a run: whether it holds the interface."""
    interface = 2.0 * case.particles.interface_width
    if case.shape_functions.kind == "linear" or mesh.width <= interface * (1.0 + 1e-9):
        return []
    _, middle = largest_gap(mesh.nodes, case.domain.size)
    place = ", ".join(f"{x:.4g}" for x in middle)
    return [
        f"the shape functions are {mesh.width:.4g} nm wide, the interface {interface:.4g} nm "
        f"(2 particles.interface_width): it is not resolved; give more nodes, the largest gap is around ({place}) nm"
    ]


def mean_distance(nodes: Floats, size: Sequence[float]) -> float:
    """The edge of the cube that each node has to itself, nm."""
    return float((math.prod(size) / len(nodes)) ** (1.0 / len(size)))


def regular(size: Sequence[float], pitch: float) -> tuple[Floats, Floats]:
    """Points and their volumes: two in each of the equal bricks that fill the box [0, size], at a quarter and three
    quarters of its diagonal. They lie like the squares of one colour on a chessboard; pitch^dim is the share of each.
    """
    edge = pitch * 2.0 ** (1.0 / len(size))
    counts = [max(1, round(length / edge)) for length in size]
    pair = []
    for place in (0.25, 0.75):
        axes = [(np.arange(n) + place) * (length / n) for length, n in zip(size, counts, strict=True)]
        pair.append(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(counts)))
    points = np.concatenate(pair)
    points = points[along_curve(points, np.zeros(len(counts)), max(size))]
    return points, np.full(len(points), math.prod(size) / len(points))


def largest_gap(nodes: Floats, size: Sequence[float]) -> tuple[float, Floats]:
    """Radius and centre of the largest ball around a place of the domain that holds no node, nm, to a few per cent.

    Probes on a grid find the likely places, finer ones around these the radius.
    """
    step = mean_distance(nodes, size) / PROBES
    axes = [np.linspace(0.0, length, 2 + int(length / step)) for length in size]
    probes, tree = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes)), cKDTree(nodes)
    distance = np.asarray(tree.query(probes)[0])
    likely = probes[np.argsort(-distance, kind="stable")[:LIKELY]]
    around = np.stack(np.meshgrid(*[np.linspace(-step, step, 9)] * len(axes), indexing="ij"), axis=-1)
    probes = np.clip(likely[:, None] + around.reshape(-1, len(axes)), 0.0, size).reshape(-1, len(axes))
    distance = np.asarray(tree.query(probes)[0])
    worst = int(distance.argmax())
    return float(distance[worst]), probes[worst]
