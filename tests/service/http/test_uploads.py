"""Files of strangers: each attack against a real child, what is kept, what is removed, what the ranks read."""

import asyncio
import base64
import json
import os
import re
import subprocess
import sys
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import meshio
import numpy as np
import pytest
from asking import TINY, Tree, gmsh_text, service
from fastapi.testclient import TestClient
from serving import PAIR, ended, settings
from serving import submit as submit_to

from frit.service.http.problems import HttpError
from frit.service.http.sniffing import HDF5, UnknownFileError, kind_of
from frit.service.http.uploads import Shelf
from frit.service.http.views import FileContent
from frit.service.jobs.engine import Engine
from frit.service.jobs.states import Job, NewJob, State
from frit.service.settings import Settings
from frit.solver import mesh_file
from frit.solver.case import parse_case
from frit.solver.geometry import MeshError, file_mesh, lattice

SIZE = (22.0, 13.0)
GRID = lattice(SIZE, 1.0)
MESH = gmsh_text(GRID.nodes.tolist(), GRID.cells.tolist())
CASE: Tree = {**TINY, "nodes": {"source": "file", "path": "m"}}


def shelf(data: Path, **changes: Any) -> Shelf:
    return Shelf(Settings(data=data, **changes))


def file_of(content: bytes) -> FileContent:
    return FileContent(content=base64.b64encode(content).decode(), encoding="base64")


def taken(data: Path, content: bytes, name: str = "m.msh", **changes: Any) -> Path:
    """The path of a file that was accepted."""
    with shelf(data, **changes).holding({name: file_of(content)}) as uploads:
        return Path(uploads.paths[name])


def refusal(data: Path, content: bytes, name: str = "m.msh", **changes: Any) -> str:
    """The one sentence of a refusal that left nothing behind."""
    with pytest.raises(HttpError) as caught:
        taken(data, content, name, **changes)
    [wrong] = caught.value.details.errors
    assert re.fullmatch(r"[ -~]{1,250}", wrong.detail)
    assert str(data) not in caught.value.details.detail
    assert left_in(data) == []
    return wrong.detail


def left_in(data: Path) -> list[str]:
    return sorted(os.listdir(data / "files")) if (data / "files").exists() else []


def written(path: Path, mesh: meshio.Mesh, **given: Any) -> bytes:
    mesh.write(path, **given)
    return path.read_bytes()


def planar(**data: Any) -> meshio.Mesh:
    nodes = np.column_stack([GRID.nodes, np.zeros(len(GRID.nodes))])
    return meshio.Mesh(nodes, [("triangle", GRID.cells)], **data)


# --- what is taken


FORMATS = [
    ("a.msh", {"file_format": "gmsh"}), ("a.msh", {"file_format": "gmsh", "binary": False}),
    ("a.msh", {"file_format": "gmsh22"}), ("a.msh", {"file_format": "gmsh22", "binary": False}),
    ("a.vtk", {"file_format": "vtk42"}), ("a.vtk", {"file_format": "vtk", "binary": False}),
    ("a.vtu", {"file_format": "vtu"}), ("a.vtu", {"file_format": "vtu", "binary": False}),
    ("a.mesh", {"file_format": "medit"}),
]  # fmt: skip


@pytest.mark.parametrize(("name", "given"), FORMATS)
def test_a_mesh_of_each_format_becomes_the_same_mesh(tmp_path: Path, name: str, given: Tree) -> None:
    content = written(tmp_path / name, planar(), **given)
    made = taken(tmp_path, content, name)
    assert mesh_file.is_own(made)
    again = file_mesh(made, SIZE)
    np.testing.assert_allclose(again.nodes, lattice(SIZE, 1.0, rows=False).nodes, atol=1e-12)


def test_su2_is_taken_too(tmp_path: Path) -> None:
    cells = "\n".join(f"5 {a} {b} {c} {k}" for k, (a, b, c) in enumerate(GRID.cells.tolist()))
    nodes = "\n".join(f"{x!r} {y!r} {k}" for k, (x, y) in enumerate(GRID.nodes.tolist()))
    text = f"% c\nNDIME= 2\nNELEM= {len(GRID.cells)}\n{cells}\nNPOIN= {len(GRID.nodes)}\n{nodes}\nNMARK= 0\n"
    made = file_mesh(taken(tmp_path, text.encode(), "a.su2"), SIZE)
    np.testing.assert_array_equal(made.nodes, lattice(SIZE, 1.0, rows=False).nodes)


def test_the_same_mesh_gives_the_same_file_whatever_its_name(tmp_path: Path) -> None:
    one = taken(tmp_path, MESH)
    first = one.read_bytes()
    assert taken(tmp_path, MESH, "other.MSH") == one
    assert one.read_bytes() == first
    assert taken(tmp_path, written(tmp_path / "v.vtu", planar()), "w.vtu") == one, "nor its format"
    assert left_in(tmp_path) == [one.name]


def test_several_meshes_are_read_by_one_child_and_the_wrong_one_is_named(tmp_path: Path) -> None:
    files = {"a.msh": file_of(MESH), "p.csv": file_of(b"1,2,3\n"), "b.msh": file_of(MESH[:-300])}
    with pytest.raises(HttpError) as caught, shelf(tmp_path).holding(files):
        pass
    assert [wrong.pointer for wrong in caught.value.details.errors] == ["/files/b.msh"]
    assert left_in(tmp_path) == []
    with shelf(tmp_path).holding({**files, "b.msh": file_of(MESH)}) as uploads:
        assert uploads.paths["a.msh"] == uploads.paths["b.msh"] != uploads.paths["p.csv"]


# --- attacks


def test_an_abaqus_include_reads_nothing(tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("1, 0.5, 0.5, 0.0\n")
    text = f"*HEADING\n*NODE\n*INCLUDE, INPUT={tmp_path / 'secret'}\n*ELEMENT, TYPE=CPS3\n1, 1, 2, 3\n".encode()
    assert refusal(tmp_path, text).startswith("is none of the known")
    refusal(tmp_path, text.replace(b"secret", b"nowhere"))
    assert refusal(tmp_path, text, "m.inp").startswith("must end in one of")


def external(path: Path, secret: Path, userblock: int) -> bytes:
    with h5py.File(path, "w", userblock_size=userblock) as file:
        file.create_dataset("x", shape=(64,), dtype="u1", external=[(str(secret), 0, 64)])
    return path.read_bytes()


@pytest.mark.parametrize("userblock", [0, 512, 1024, 4096])
@pytest.mark.parametrize("name", ["m.msh", "m.vtk"])
def test_hdf5_is_refused_wherever_it_begins(tmp_path: Path, name: str, userblock: int) -> None:
    secret = tmp_path / "secret"
    secret.write_bytes(b"s" * 64)
    content = external(tmp_path / "m.h5", secret, userblock)
    assert content.find(HDF5) == userblock
    before = MESH[:200] if userblock else b""
    hidden = before + content[len(before) :]
    assert refusal(tmp_path, hidden, name) == "is HDF5, which can refer to other files"


XDMF = b"""<?xml version="1.0"?>
<Xdmf Version="3.0"><Domain><Grid><Geometry><DataItem Format="HDF">/etc/secret.h5:/x</DataItem></Geometry></Grid>
</Domain></Xdmf>"""
BOMB = b"""<?xml version="1.0"?><!DOCTYPE a [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;">]>
<VTKFile type="UnstructuredGrid">&b;</VTKFile>"""
OUTSIDE = b"""<!DOCTYPE a [<!ENTITY e SYSTEM "file:///etc/passwd">]><VTKFile type="UnstructuredGrid">&e;</VTKFile>"""
LATER = b"""<VTKFile type="UnstructuredGrid"><!--""" + b" " * 9000 + b"--><!DOCTYPE a></VTKFile>"
INCLUDES = b"""<VTKFile type="UnstructuredGrid" xmlns:xi="http://www.w3.org/2001/XInclude"><xi:include href="/x"/>"""
PARALLEL = b"""<VTKFile type="PUnstructuredGrid"><PUnstructuredGrid><Piece Source="/x.vtu"/></PUnstructuredGrid>
</VTKFile>"""


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (XDMF, "XML other than VTU"),
        (BOMB, "XML other than VTU"),
        (OUTSIDE, "XML other than VTU"),
        (LATER, "declares or includes"),
        (INCLUDES, "declares or includes"),
        (b"<?xml version='1.0' encoding='cp037'?><VTKFile>", "in an encoding other than"),
        (BOMB.decode().encode("utf-16"), "is none of the known"),
        (PARALLEL, "cannot read it"),
        (b"", "is none of the known"),
        (b"\x7fELF\x00\x01", "is none of the known"),
        (b"$MeshFormat\n9.1 0 8\n$EndMeshFormat\n", "in a version other than"),
        (b"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n", "must have 2 or 3 coordinates per node"),
        (b"$MeshFormat\n4.1 1 8\n\x01\x00\x00\x00\n$EndMeshFormat\n$Nodes\n" + b"\xff" * 64, "cannot read it"),
        (b"# vtk DataFile Version 4.2\nx\x1b[31m/etc/passwd\nASCII\n\x1b[31m\xff\n", "cannot read it"),
        (b"MeshVersionFormatted 1\nDimension 9\n", "cannot read it"),
        (b"NDIME= 2\nNPOIN= 1\n/etc/passwd /etc/shadow\n", "cannot read it"),
        (gmsh_text([[0.0, 0.0], [1.0, 0.0]], []), "holds no triangles or tetrahedra"),
        (gmsh_text([[0.0, 0.0], [1.0, 0.0]], [[0, 1, 7]]), ""),
    ],
)  # fmt: skip
def test_whatever_is_no_complete_mesh_is_refused_in_a_sentence(tmp_path: Path, content: bytes, why: str) -> None:
    said = refusal(tmp_path, content)
    assert why in said
    assert "/etc" not in said


def test_a_bomb_in_a_vtu_hits_the_limit_of_memory(tmp_path: Path) -> None:
    blocks, size = 40, 1 << 26
    packed = zlib.compress(bytes(size), 9)
    header = np.array([blocks, size, size, *[len(packed)] * blocks], dtype="<u4").tobytes()
    data = base64.b64encode(header).decode() + base64.b64encode(packed * blocks).decode()
    text = (
        '<VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian" header_type="UInt32" '
        f'compressor="vtkZLibDataCompressor"><UnstructuredGrid><Piece NumberOfPoints="{blocks * size // 24}" '
        'NumberOfCells="0"><Points><DataArray type="Float64" NumberOfComponents="3" format="binary">'
        f"{data}</DataArray></Points></Piece></UnstructuredGrid></VTKFile>"
    )
    said = refusal(tmp_path, text.encode(), "m.vtu", upload_memory=1_000_000_000)
    assert said == "needs more than the 1e+09 bytes of memory that are allowed"


def test_a_mesh_that_claims_to_be_huge_hits_the_limit_of_memory(tmp_path: Path) -> None:
    text = b"# vtk DataFile Version 3.0\nx\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 900000000 double\n0 0 0\n"
    said = refusal(tmp_path, text, "m.vtk", upload_memory=1_000_000_000)
    assert said.startswith("needs more than the 1e+09 bytes of memory") or "cannot read it" in said


def test_a_mesh_that_takes_too_long_is_given_up(tmp_path: Path) -> None:
    began = time.monotonic()
    assert "takes more than the 0.1 s" in refusal(tmp_path, MESH, upload_seconds=0.1)
    assert time.monotonic() - began < 20.0
    assert not [name for name in os.listdir("/proc") if name.isdigit() and mentions(name, str(tmp_path / "files"))]


def mentions(pid: str, text: str) -> bool:
    try:
        return os.readlink(f"/proc/{pid}/cwd").startswith(text)
    except OSError:
        return False


def test_a_mesh_that_becomes_too_large_is_refused(tmp_path: Path) -> None:
    assert "File too large" in refusal(tmp_path, MESH, upload_bytes=10_000)


def test_a_reader_that_wants_another_file_does_not_get_it(tmp_path: Path) -> None:
    """What no known reader does: the child itself stands in the way of the Abaqus reader."""
    (tmp_path / "secret").write_text("1, 0.0, 0.0\n2, 1.0, 0.0\n3, 0.0, 1.0\n")
    (tmp_path / "in").write_text("*NODE\n*INCLUDE, INPUT=secret\n*ELEMENT, TYPE=CPS3\n1, 1, 2, 3\n")
    command = [sys.executable, "-P", "-m", "frit.solver.convert", "2000000000", "60", "1000000"]
    asked = json.dumps([["in", "abaqus", "out"]])
    done = subprocess.run(command, input=asked, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "asks for another file" in json.loads(done.stdout), done.stderr
    assert not (tmp_path / "out").exists()


# --- particles


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"x,y,radius\n" + b"1,1,1\n" * 2000, "has 2001 lines, must be at most 10 particles"),
        (b"1,1," + b"1" * 2000 + b"\n", "has a line longer than"),
        (b"hello world\n", "is none of the known"),
    ],
)
def test_particle_files_are_bounded_before_they_are_read(tmp_path: Path, content: bytes, why: str) -> None:
    assert why in refusal(tmp_path, content, "p.csv", particles_limit=10)


@pytest.mark.parametrize("text", ["1 2 3\n", "# c\n\nx;y;radius\n1;2;3\n", "\ufeffx,y,r\n", "-1e3\t.5\t+2.\n"])
def test_particles_are_known_by_their_first_line(text: str) -> None:
    assert kind_of(text.encode()) == "particles"
    with pytest.raises(UnknownFileError):
        kind_of(b"a" + text.encode())


# --- what stays


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("uploads")


@pytest.fixture(scope="module")
def client(data: Path) -> Iterator[TestClient]:
    with service(data, queue_limit=2, nodes_limit=2000) as client:
        yield client


def submit(client: TestClient, case: Tree, content: bytes) -> Any:
    body = {"case": case, "files": {"m.msh": file_of(content).model_dump()}}
    return client.post("/v1/jobs", json=body)


NAMED = {**CASE, "nodes": {"source": "file", "path": "m.msh"}}


def test_refused_requests_leave_nothing_and_accepted_ones_their_mesh(data: Path, client: TestClient) -> None:
    wrong = {**NAMED, "time": {"end": -1.0}}
    assert submit(client, wrong, MESH).status_code == 422
    fine = lattice(SIZE, 0.25)
    large = gmsh_text(fine.nodes.tolist(), fine.cells.tolist())
    refused = submit(client, NAMED, large)
    assert refused.json()["errors"][0]["pointer"] == "/case/nodes/path"
    assert "nodes, must be at most 2000" in refused.json()["detail"]
    assert left_in(data) == []
    made = submit(client, NAMED, MESH)
    assert made.status_code == 201, made.text
    assert left_in(data) == [made.json()["case"]["nodes"]["path"]]
    assert submit(client, wrong, MESH).status_code == 422
    assert len(left_in(data)) == 1, "another's stays"
    assert submit(client, NAMED, MESH).status_code == 201
    other = gmsh_text(GRID.nodes.tolist(), GRID.cells[::-1].tolist())
    assert submit(client, NAMED, other).status_code == 429
    assert len(left_in(data)) == 1


def test_what_is_used_or_held_or_new_is_not_tidied_away(tmp_path: Path) -> None:
    kept = shelf(tmp_path)
    old = time.time() - 2 * 86_400.0
    used, unused, held = (taken(tmp_path, f"{k},2,3\n".encode(), "p.csv") for k in range(3))
    (tmp_path / "files" / ".new-torn").mkdir()
    for path in (used, unused, held, tmp_path / "files" / ".new-torn"):
        os.utime(path, (old, old))
    with kept.holding({"p.csv": file_of(b"2,2,3\n")}):
        os.utime(held, (old, old))
        assert sorted(kept.tidy([used.name])) == sorted([unused.name, ".new-torn"])
    with kept.holding({"p.csv": file_of(b"2,2,3\n")}):
        pass
    assert kept.tidy([]) == [used.name], "what was used again is new again"


def test_the_index_tells_which_files_are_used(tmp_path: Path) -> None:
    with service(tmp_path) as client:
        job = submit(client, NAMED, MESH).json()["case"]["nodes"]["path"]
        other = gmsh_text(GRID.nodes.tolist(), GRID.cells[::-1].tolist())
        sweep = {"name": "s", "base": NAMED, "axes": {"model.A": [1.0, 2.0]}}
        body = {"definition": sweep, "files": {"m.msh": file_of(other).model_dump()}}
        assert client.post("/v1/sweeps", json=body).status_code == 201
        used = client.app.state.engine.store.files_used()  # type: ignore[attr-defined]
        assert sorted(used) == left_in(tmp_path)
        assert job in used


# --- ranks


def test_ranks_read_of_uploads_only_what_was_converted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where an index of an earlier time has queued it."""
    folder = tmp_path / "files"
    folder.mkdir()
    (folder / "m.msh").write_bytes(MESH)
    assert len(file_mesh(folder / "m.msh", SIZE).nodes)
    monkeypatch.setenv("FRIT_UPLOADS", str(folder))
    (tmp_path / "link.msh").symlink_to(folder / "m.msh")
    for path in (folder / "m.msh", tmp_path / "link.msh"):
        with pytest.raises(MeshError, match="was uploaded in a form that is not read any more"):
            file_mesh(path, SIZE)
    own = taken(tmp_path, MESH)
    assert len(file_mesh(own, SIZE).nodes)
    own.write_bytes(own.read_bytes()[:-8])
    with pytest.raises(MeshError, match="damaged"):
        file_mesh(own, SIZE)


def test_a_job_that_an_older_index_has_queued_is_refused_by_its_ranks(tmp_path: Path) -> None:
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "m.msh").write_bytes(MESH)
    case = parse_case({**PAIR, "nodes": {"source": "file", "path": str(tmp_path / "files" / "m.msh")}})

    async def run() -> Job:
        async with Engine(settings(tmp_path)) as engine:
            [job] = await submit_to(engine, NewJob(json.dumps(case.tree()), case.identity(), "old"))
            return (await ended(engine, job))[0]

    job = asyncio.run(run())
    assert job.state is State.FAILED
    assert "was uploaded in a form that is not read any more" in (job.message or "")


# --- nothing that a stranger sends makes a thread match for ever


@pytest.mark.parametrize(
    "head",
    [
        b"<!---->" * 585, b"<!--" * 1000, b"<?xml" + b" ?>" * 1300, b"<" + b" " * 4000, b" %\n" * 1300, b" #\n" * 1300,
        b"% \n " * 800, b"#" * 4000, b" " * 4000, b"\n" * 4000, b"1" * 4000 + b"x", b"1." * 2000, b"1e" * 2000,
        b"MeshVersionFormatted" + b" " * 4000, b"NDIME" + b" " * 4000, b"$MeshFormat" + b" " * 4000,
        b"<?xml encoding" + b" " * 4000 + b"?>", b"1," * 2000 + b"x", b"x,y,radius\n" + b"9" * 900,
    ],
)  # fmt: skip
def test_what_is_looked_for_in_a_head_is_found_in_a_moment(head: bytes) -> None:
    """A process that hangs here would hang the service; it is given twenty seconds, where it needs none."""
    code = """if True:
        import resource, sys
        from frit.service.http.sniffing import UnknownFileError, kind_of
        resource.setrlimit(resource.RLIMIT_CPU, (20, 20))
        try:
            kind_of(sys.stdin.buffer.read())
        except UnknownFileError:
            pass
    """
    assert subprocess.run([sys.executable, "-P", "-c", code], input=head, check=False).returncode == 0


def test_a_cell_of_many_digits_is_looked_at_once() -> None:
    """The interpreter is held meanwhile: nobody else is answered."""
    began = time.process_time()
    with pytest.raises(UnknownFileError):
        kind_of(b"1" * 4095 + b"x")
    assert time.process_time() - began < 0.1


@pytest.mark.parametrize(
    "text",
    [
        b"MeshVersionFormatted 2\nDimension 2\nRidges\n1000000000\n1\n", b"NDIME= 2\nNPOIN= 99999999999\n0 0 0\n",
        b"MeshVersionFormatted 2\nDimension\n2\nVertices\n99999999999999999999\n",
    ],
)  # fmt: skip
def test_a_text_that_announces_more_than_it_has_is_not_read(tmp_path: Path, text: bytes) -> None:
    assert refusal(tmp_path, text).startswith("announces ")


def test_uploads_stay_where_the_index_does_not_know_all_runs(tmp_path: Path) -> None:
    """A service that was started before `frit reindex` would remove what the jobs of the lost index use."""
    path = taken(tmp_path, MESH)
    os.utime(path, (0, 0))
    (tmp_path / "runs" / "0123456789abcdef").mkdir(parents=True)
    with service(tmp_path):
        time.sleep(1.0)
    assert path.exists()
    (tmp_path / "runs" / "0123456789abcdef").rmdir()
    with service(tmp_path):
        deadline = time.monotonic() + 60.0
        while path.exists():
            assert time.monotonic() < deadline
            time.sleep(0.05)
