"""Pictures of synthetic runs: tanh discs and spheres on scattered nodes, their colours and places known."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from matplotlib.image import imread
from scipy.spatial import cKDTree

from frit.solver.arrays import Floats
from frit.sweeps import curves, plots, surface
from frit.sweeps.pictures import COLOURS, Look, draw_panels, movie
from frit.sweeps.plots import PlotError
from frit.sweeps.ranking import Outcome, rank

SIZE = [60.0, 36.0]
CENTRES = np.array([[18.0, 18.0], [42.0, 18.0]])
RADII = np.array([12.0, 12.0])


def write_case(directory: Path, size: list[float], name: str = "two $equal_ discs$") -> None:
    box = [[0.1 * s for s in size], [0.9 * s for s in size]]
    case = {"name": name, "domain": {"size": size}, "output": {"vacancy_box": box}}
    (directory / "case.json").write_text(json.dumps(case))


def write_snapshots(
    directory: Path, nodes: Floats, centres: Floats, radii: Floats, times: tuple[float, ...] = (0.0, 5.0)
) -> None:
    """eta_a = 1/2 (1 - tanh(d - R)), halved where a neighbour is as near; R grows by 1 % per unit of time."""
    group = zarr.create_group(directory / "snapshots.zarr")
    group.create_array("nodes", data=nodes)
    group.create_array("time", data=np.array(times))
    fields = []
    for time in times:
        gap = np.linalg.norm(nodes[:, None] - centres, axis=-1) - radii * (1 + 0.01 * time)
        other = np.where(np.eye(len(radii), dtype=bool), np.inf, gap[:, None]).min(axis=-1)
        eta = 0.25 * (1 - np.tanh(gap)) * (1 - np.tanh((gap - other) / 2))
        owner = np.where(eta.max(axis=1) > 0.1, eta.argmax(axis=1), -1)
        fields.append((0.5 * (1 - np.tanh(gap.min(axis=1))), owner, (eta**2).sum(axis=1)))
    for name, column in zip(("rho", "particle", "eta_squared"), zip(*fields, strict=True), strict=True):
        group.create_array(name, data=np.stack(column))


def write_history(directory: Path, rows: int = 5) -> None:
    """Written as rank 0 does, a row a line; the neck comes late, a list and a word are in every row."""
    with (directory / "history.jsonl").open("w") as file:
        for k in range(rows):
            row = {"time": 0.5 * k, "step": k, "vacancy_ratio": 0.3 - 0.01 * k, "free_energy": 800.0 - k}
            late = {"live_fraction": 0.4, "volumes": [1.0, 2.0], "neck_length": None if k < 2 else float(k)}
            file.write(json.dumps(row | late) + "\n")


def scattered(size: list[float], spacing: float, seed: int = 0) -> Floats:
    """A jittered lattice in random order, with nodes on the domain's edges."""
    axes = [np.linspace(0, s, round(s / spacing) + 1) for s in size]
    nodes = np.stack([x.ravel() for x in np.meshgrid(*axes)], axis=-1)
    random = np.random.default_rng(seed)
    inside = np.all((nodes > 0) & (nodes < size), axis=1)
    nodes[inside] += random.uniform(-0.3, 0.3, (inside.sum(), len(size))) * spacing
    shuffled: Floats = random.permutation(nodes)
    return shuffled


@pytest.fixture
def discs(tmp_path: Path) -> Path:
    write_case(tmp_path, SIZE)
    write_snapshots(tmp_path, scattered(SIZE, 1.0), CENTRES, RADII)
    return tmp_path


def test_history_has_the_scalar_columns_and_leaves_out_a_torn_last_line(tmp_path: Path) -> None:
    write_history(tmp_path)
    with (tmp_path / "history.jsonl").open("a") as file:
        file.write('{"time": 2.5, "st')
    history = plots.read_history(tmp_path)
    assert list(history) == ["time", "step", "vacancy_ratio", "free_energy", "live_fraction", "neck_length"]
    np.testing.assert_array_equal(history["time"], [0.0, 0.5, 1.0, 1.5, 2.0])
    np.testing.assert_array_equal(history["neck_length"], [np.nan, np.nan, 2, 3, 4])
    assert history["step"].dtype.kind == "i"


def test_a_wrong_line_inside_the_history_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "history.jsonl").write_text('{"time": 0}\nrubbish\n{"time": 1}\n')
    with pytest.raises(ValueError, match=r"history\.jsonl, line 2"):
        plots.read_history(tmp_path)


def test_no_history_is_an_empty_one_and_cannot_be_drawn(tmp_path: Path) -> None:
    assert plots.read_history(tmp_path) == {}
    with pytest.raises(PlotError, match="no history"):
        plots.plot_history(tmp_path, tmp_path / "history.png")


@pytest.mark.parametrize("rows", [1, 5])
def test_history_picture(tmp_path: Path, rows: int) -> None:
    write_case(tmp_path, SIZE)
    write_history(tmp_path, rows)
    plots.plot_history(tmp_path, tmp_path / "h.png")
    assert imread(tmp_path / "h.png").min(axis=(0, 1))[0] < 0.3  # curves, and text, on white


@pytest.mark.parametrize("size", [[12.0, 9.0], [9.0, 8.0, 7.0]])
def test_interpolation_is_exact_for_linear_fields(size: list[float]) -> None:
    """Also at nodes and on the edges; 1e-7 allows for the 1e-9 that keeps the moment matrix regular."""
    nodes = scattered(size, 1.0)
    slope = np.array([[1.0, -2.0, 0.5][: len(size)], [0.0, 3.0, 1.0][: len(size)]]).T
    at = np.concatenate([np.random.default_rng(1).uniform(0, size, (200, len(size))), nodes[:50]])
    near, weight = plots.interpolation(cKDTree(nodes), at)
    found = np.einsum("pa,paf->pf", weight, (4.0 + nodes @ slope)[near])
    np.testing.assert_allclose(found, 4.0 + at @ slope, atol=1e-7)


def test_touching_particles_differ_in_colour() -> None:
    """Discs on a hexagonal lattice, 10 apart: a pair of one colour that is no farther apart would touch."""
    rows, columns = np.divmod(np.arange(42), 7)
    centres = 10 * np.column_stack([columns + 0.5 * (rows % 2) + 1, np.sqrt(0.75) * rows + 1])
    nodes = scattered([90.0, 65.0], 1.0)
    distance = np.linalg.norm(nodes[:, None] - centres, axis=-1)
    owner = np.where(distance.min(axis=1) < 5, distance.argmin(axis=1), -1)
    colours = plots.particle_colours(nodes, owner)
    assert colours.shape == (43, 3)
    apart = np.linalg.norm(centres[:, None] - centres, axis=-1)
    alike = (colours[:-1, None] == colours[:-1]).all(axis=-1) & (apart > 0)
    assert apart[alike].min() > 10.1


def test_section_shows_particles_boundary_and_vacancy(discs: Path) -> None:
    snapshot = plots.read_snapshot(discs, 5.0)
    colours = plots.particle_colours(snapshot.nodes, snapshot.first_owner)
    cut = plots.Section(snapshot.nodes, np.array(SIZE), (0, 1))
    rho, picture = cut.shown(snapshot, colours)

    def at(px: float, py: float) -> Floats:
        pixel: Floats = picture[np.argmin(abs(cut.y - py)), np.argmin(abs(cut.x - px))]
        return pixel

    np.testing.assert_allclose(at(18, 18), colours[0], atol=0.02)
    np.testing.assert_allclose(at(42, 18), colours[1], atol=0.02)
    np.testing.assert_allclose(at(2, 2), 1.0, atol=0.01)
    assert at(30, 18).max() < 0.45  # two grains meet
    area = (rho > 0.5).mean() * np.prod(SIZE)
    lens = 2 * (12.6**2 * np.arccos(12 / 12.6) - 12 * np.sqrt(12.6**2 - 12**2))
    assert area == pytest.approx(2 * np.pi * 12.6**2 - lens, rel=0.01)  # a pixel's width along the rim


def test_snapshot_nearest_in_time_is_drawn_and_the_store_left_as_it_was(discs: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in discs.rglob("*")}
    assert len(before) > 10
    assert plots.nearest_time(discs, 3.0) == 5.0
    assert draw_panels(discs, [3.0], discs / "s.png") == [5.0]
    assert {path: path.stat().st_mtime_ns for path in discs.rglob("*") if path.name != "s.png"} == before
    picture = imread(discs / "s.png")[..., :3]
    for colour in plots.PALETTE[:2]:
        wanted = np.array([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])
        assert (abs(picture - wanted).max(axis=-1) < 0.02).mean() > 0.1  # each disc is a fifth of the domain


def test_three_sections_of_spheres(tmp_path: Path) -> None:
    size = [16.0, 12.0, 10.0]
    write_case(tmp_path, size, "spheres")
    centres, radii = np.array([[4.5, 6, 5], [11.5, 6, 5]]), np.array([3.5, 3.5])
    write_snapshots(tmp_path, scattered(size, 1.0), centres, radii)
    assert draw_panels(tmp_path, [0.0], tmp_path / "s.png", Look(sections=True)) == [0.0]
    height, width = imread(tmp_path / "s.png").shape[:2]
    assert width > 2 * height


def test_particles_without_nodes_and_nodes_without_particles(tmp_path: Path) -> None:
    """The last frame may be all vacancy; the colours do not need the particles to be there."""
    write_case(tmp_path, SIZE)
    write_snapshots(tmp_path, scattered(SIZE, 2.0), CENTRES, RADII, times=(0.0, -100.0))
    assert draw_panels(tmp_path, [-100.0], tmp_path / "s.png") == [-100.0]


def test_missing_or_empty_snapshots_are_named(tmp_path: Path) -> None:
    write_case(tmp_path, SIZE)
    with pytest.raises(PlotError, match="no snapshots"):
        draw_panels(tmp_path, [0.0], tmp_path / "s.png")
    zarr.create_group(tmp_path / "snapshots.zarr").create_array("time", data=np.empty(0))
    with pytest.raises(PlotError, match="no snapshots"):
        plots.nearest_time(tmp_path, 0.0)


def test_a_name_is_never_a_formula_nor_a_page(tmp_path: Path) -> None:
    """Names come from whoever submits."""
    names = [r"$\frac{", "</script><script>alert(1)</script>", "_hidden", "$x$"]
    made = [Outcome(name, name, "succeeded", {"a.b": name}, [0.0, 1.0], [0.3, 0.2]) for name in names]
    curves.write(tmp_path / "a.png", "vacancy_ratio", rank(made))
    curves.write(tmp_path / "a.html", "vacancy_ratio", rank(made))
    assert "alert(1)</script>" not in (tmp_path / "a.html").read_text()


def test_crowded_nodes_are_thinned_and_even_ones_are_not() -> None:
    """Columns 0.01 nm apart: the nine nearest nodes would all lie on one line."""
    even = scattered([20.0, 12.0], 1.0)
    assert plots.thinned(even).sum() > 0.95 * len(even)
    columns = np.sort(np.concatenate([np.arange(0.0, 20.0, 2.0), np.arange(0.0, 20.0, 2.0) + 0.01]))
    paired = np.stack(np.meshgrid(columns, np.arange(0.0, 12.0, 1.0)), axis=-1).reshape(-1, 2)
    kept = paired[plots.thinned(paired)]
    assert len(kept) == len(paired) / 2
    near = np.asarray(cKDTree(kept).query(np.array([9.0, 6.0]), 9)[1])
    assert len(np.unique(kept[near, 0])) > 1


@pytest.mark.parametrize("colour", COLOURS)
def test_before_and_after_in_one_figure(discs: Path, colour: Any) -> None:
    assert draw_panels(discs, [0.0, 4.9, 5.1], discs / "p.png", Look(colour)) == [0.0, 5.0], "each once"
    height, width = imread(discs / "p.png").shape[:2]
    assert width > 2 * height
    picture = imread(discs / "p.png")[..., :3]
    blank = (picture > 0.99).all(axis=-1).mean()
    assert 0.1 < blank < 0.9


def test_spheres_are_a_lit_surface(tmp_path: Path) -> None:
    """Two spheres in two colours, each in many shades; nodes of a lattice, and scattered ones."""
    size = [16.0, 12.0, 10.0]
    centres, radii = np.array([[4.5, 6, 5], [11.5, 6, 5]]), np.array([3.5, 3.5])
    places = np.stack(np.meshgrid(*(np.arange(s + 1) for s in size), indexing="ij"), axis=-1).reshape(-1, 3)
    for name, nodes in (("lattice", places), ("scattered", scattered(size, 1.0))):
        (tmp_path / name).mkdir()
        write_case(tmp_path / name, size, "spheres")
        write_snapshots(tmp_path / name, nodes, centres, radii)
        snapshot = plots.read_snapshot(tmp_path / name, 0.0)
        grid = surface.gridded(snapshot.nodes, snapshot.rho, snapshot.owner, np.array(size))
        found = surface.seen(grid, np.array(size), np.array([[1.0, 0, 0], [0, 0, 1.0], [0, 1.0, 0]]))
        solid = found.picture[..., 3] > 0
        pixel = (found.extent[1] - found.extent[0]) * (found.extent[3] - found.extent[2]) / solid.size
        area = solid.sum() * pixel
        assert 1.2 * np.pi * 3.5**2 < area < 2.1 * np.pi * 3.5**2, "two discs, one partly behind the other"
        red, green, blue = found.picture[solid, :3].T
        assert not green.any()
        assert (red > 0).mean() > 0.3
        assert (blue > 0).mean() > 0.3
        assert len(np.unique(red.round(2))) > 20, "shades"


def test_a_time_far_from_any_snapshot_is_told(discs: Path) -> None:
    assert plots.far_away(discs, 2.0) is None
    assert plots.far_away(discs, 5.0) is None
    assert plots.far_away(discs, 9.0) == (
        "there is no snapshot near t = 9: the nearest is at t = 5; there are 0, 5"
    )  # fmt: skip


def test_all_snapshots_as_a_movie(discs: Path) -> None:
    from PIL import Image

    with Image.open(movie(discs, discs / "m.gif")) as made:
        assert made.n_frames == 2  # type: ignore[attr-defined]
    with pytest.raises(PlotError, match="at most 12"):
        draw_panels(discs, [0.0] * 13, discs / "p.png")
