"""Requests that nobody sends by mistake: one function per kind, each draws from a seeded source of randomness."""

import base64
import io
import json
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import h5py
import numpy as np
from asking import PACKING, TINY, Tree

JSON = {"Content-Type": "application/json"}
BAD = [
    "\x1b[31mRED",
    "a\nb",
    "\x9b31m",
    "\u202egnp",
    "\u2028",
    "\x00",
    "\x7f",
    "\ud800",
    "\ufeff",
    "{{7*7}}",
    "'; DROP",
]
NUMBERS: list[Any] = [
    0,
    -1,
    1e308,
    -1e308,
    5e-324,
    1e-12,
    10**30,
    2**63,
    -(2**63),
    float("nan"),
    float("inf"),
    True,
    None,
    "1",
    [],
]
KEYS = [
    ("time", "end"),
    ("time", "step"),
    ("time", "tolerance"),
    ("nodes", "spacing"),
    ("domain", "size"),
    ("output", "history_every"),
    ("output", "snapshots"),
    ("output", "checkpoint_every"),
    ("output", "vacancy_box"),
    ("shape_functions", "gamma"),
    ("shape_functions", "tolerance"),
    ("model", "D_surf"),
    ("model", "c"),
    ("particles", "radii"),
    ("particles", "centres"),
    ("particles", "interface_width"),
    ("particles", "seed"),
    ("activation", "eps_rho"),
    ("particles", "path"),
    ("nodes", "path"),
]


@dataclass(frozen=True)
class Nasty:
    """A request. `known`: whether it brings a token that counts."""

    kind: str
    method: str
    path: str
    body: bytes = b""
    headers: dict[str, str] = field(default_factory=lambda: dict(JSON))
    known: bool = True


def dumped(tree: Any) -> bytes:
    return json.dumps(tree).encode()


def job(case: Any, **more: Any) -> bytes:
    return dumped({"case": case, **more})


def posted(kind: str, body: bytes, path: str = "/v1/jobs", **more: Any) -> Nasty:
    return Nasty(kind, "POST", path, body, **more)


# --- who asks


def stranger(r: random.Random) -> Nasty:
    """Much, or rubbish, from who has no token."""
    size = r.choice([1, 10, 100_000, 3_000_000, 19_000_000])
    body = r.choice([b"{},", b"[", b'{"a":', b"\xff", b" "]) * (size // 3)
    path = r.choice(["/v1/jobs", "/v1/sweeps", "/v1/jobs/abcd/cancel", "/v1/none"])
    return posted("stranger", body, path, known=False)


def names(r: random.Random) -> Nasty:
    """Hosts and origins that are none."""
    word = r.choice(["http://[::1", "http://[", "//", "null", "", "http://a]b", "javascript:", "http://" + "a" * 5000])
    header = r.choice(["Origin", "Referer", "Sec-Fetch-Site", "X-Forwarded-For", "X-Forwarded-Host", "Forwarded"])
    return posted("names", job(TINY, tags=["fuzz"]), headers={**JSON, header: word}, known=r.random() < 0.5)


def tokens(r: random.Random) -> Nasty:
    """Tokens that are none."""
    word = r.choice(["Bearer", "Bearer ", "Bearer frit_" + "A" * 43, "Basic QTpC", "Bearer " + "x" * 60_000, "\xff"])
    return Nasty(
        "tokens", "GET", r.choice(["/v1/jobs", "/metrics", "/v1/events"]), headers={"Authorization": word}, known=False
    )


# --- bodies


def torn(r: random.Random) -> Nasty:
    """A good body with some bytes changed, cut or doubled."""
    body = bytearray(job(TINY, name="x", tags=["a"]))
    for _ in range(r.randint(1, 5)):
        place = r.randrange(len(body))
        match r.randrange(4):
            case 0:
                body[place] = r.randrange(256)
            case 1:
                del body[place:]
                body += b" "
            case 2:
                body[place:place] = body[: r.randrange(len(body))]
            case _:
                body[place:place] = r.choice(
                    [b"\x00", b"\\u0000", b"1e999", b"-0", b"NaN", b"\\ud800", b"\xef\xbb\xbf"]
                )
    return posted("torn", bytes(body), r.choice(["/v1/jobs", "/v1/sweeps"]))


def deep(r: random.Random) -> Nasty:
    """Within, within, within."""
    depth = r.choice([20, 30, 1000, 100_000])
    opening, closing = r.choice([("[", "]"), ('{"a":', "}"), ('{"axes":', "}"), ('[{"path":', "}]")])
    inner = opening * depth + "1" + closing * depth
    return posted("deep", f'{{"case": {inner}}}'.encode())


def many_values(r: random.Random) -> Nasty:
    """Millions of small things."""
    item = r.choice(["{}", "[]", '""', "1", '"x"', "null", "[1,2]", '{"a":1}', "1.5e-7"])
    inner = ",".join([item] * r.choice([1000, 100_000, 1_500_000]))
    place = r.choice(
        [
            '{"case": [%s]}',
            '{"case": {"particles": {"radii": [%s]}}}',
            '{"tags": [%s], "case": {}}',
            "[%s]",
            '{"case": {"output": {"snapshots": [%s]}}}',
            '{"definition": {"axes": {"time.end": [%s]}}}',
        ]
    )
    return posted("many values", (place % inner).encode(), r.choice(["/v1/jobs", "/v1/sweeps"]))


def many_keys(r: random.Random) -> Nasty:
    """Unknown keys without end, short and long."""
    n = r.choice([100, 900, 5000, 200_000])
    width = r.choice([1, 40, 2000]) if n < 6000 else 1
    more = {f"{'k' * width}{k}": r.choice([1, {}, [], "x"]) for k in range(n)}
    tree = r.choice(
        [
            {"case": more},
            {"case": TINY, **more},
            {"case": {**TINY, "model": more}},
            {"case": TINY, "files": {name: {"content": "x"} for name in more}},
        ]
    )
    return posted("many keys", dumped(tree))


def long_words(r: random.Random) -> Nasty:
    """Names, tags, keys and numbers of very many characters."""
    word = r.choice(["a", "\u00e9", "\\", '"', "~/", "\U0001f4a9"]) * r.choice([501, 10_000, 300_000])
    case = r.choice([{**TINY, "name": word}, {**TINY, word: word}, {**TINY, "nodes": {"spacing": word}}, TINY])
    tree = {"case": case, "name": word, "tags": [word], "files": {word: {"content": word}}}
    return posted("long words", dumped({key: tree[key] for key in ["case", *r.sample(sorted(tree), 2)]}))


def long_numbers(r: random.Random) -> Nasty:
    digits = "1" * r.choice([400, 5000, 2_000_000])
    number = r.choice([digits, f"0.{digits}", f"1e{digits}", f"-{digits}e-5"])
    return posted("long numbers", json.dumps({"case": {**TINY, "time": {"end": "?"}}}).replace('"?"', number).encode())


def control_characters(r: random.Random) -> Nasty:
    """In all that is ever shown."""
    bad = r.choice(BAD)
    tree = r.choice(
        [
            {"case": {**TINY, "name": bad}},
            {"case": TINY, "name": bad},
            {"case": TINY, "tags": [bad]},
            {"case": {**TINY, bad: bad}},
            {"case": {**TINY, "nodes": {"source": bad}}},
            {"case": TINY, bad: 1},
            {"case": {**TINY, "nodes": {"source": "file", "path": bad}}, "files": {bad: {"content": bad}}},
        ]
    )
    return posted("control characters", dumped(tree))


# --- cases


def values(r: random.Random) -> Nasty:
    """One or two values that cannot be, or must not."""
    case = json.loads(json.dumps(r.choice([TINY, PACKING])))
    for table, key in r.sample(KEYS, r.choice([1, 1, 2])):
        value: Any = r.choice(NUMBERS)
        value = r.choice([value, [value, value], {"every": value}, [[value] * 2, [value] * 3]])
        case.setdefault(table, {})[key] = value
    return posted("values", job(case))


def too_much(r: random.Random) -> Nasty:
    """Possible by itself, and too much for any machine."""
    case = json.loads(json.dumps(r.choice([TINY, PACKING])))
    changes: list[tuple[str, Tree]] = [
        ("output", {"snapshots": {"every": r.choice([1e-12, 1e-9, 1e-7])}}),
        ("output", {"history_every": r.choice([1e-12, 5e-324, 1e-300])}),
        ("time", {"end": r.choice([1e308, 1e30, 1e12]), "integrator": "adaptive"}),
        ("time", {"end": 1e6, "integrator": "rk2", "step": 1e-9}),
        ("nodes", {"spacing": r.choice([1e-3, 1e-6, 1e-300])}),
        ("domain", {"size": [r.choice([1e4, 1e9, 1e300])] * r.choice([2, 3])}),
        (
            "particles",
            {
                "source": "packing",
                "mean_radius": r.choice([0.012, 1e-6, 1e-150]),
                "packing_density": 0.5,
                "container": [[1.0, 1.0], [20.0, 12.0]],
            },
        ),
        (
            "particles",
            {
                "source": "packing",
                "mean_radius": 5.0,
                "count": r.choice([10**6, 10**9, 10**18]),
                "container": [[1.0, 1.0], [20.0, 12.0]],
            },
        ),
    ]
    for table, change in r.sample(changes, 2):
        case[table] = change if "source" in change or "size" in change else {**case.get(table, {}), **change}
    return posted("too much", job(case, ranks=r.choice([1, 2, 10**6])))


def overlaps(r: random.Random) -> Nasty:
    """One large disc and many small ones, all at one place, or in a row."""
    n = r.choice([10, 1000, 8000, 30_000])
    size = [1000.0, 1000.0]
    match r.randrange(3):
        case 0:
            centres = [[500.0, 500.0]] + [[r.uniform(1, 999), r.uniform(1, 999)] for _ in range(n)]
            radii = [499.0] + [1.0] * n
        case 1:
            centres, radii = [[500.0, 500.0]] * n, [1.0] * n
        case _:
            centres = [[2.0 + 996.0 * k / n, 500.0] for k in range(n)]
            radii = [r.choice([0.5, 1.0, 2.0]) for _ in range(n)]
    case = {
        **TINY,
        "domain": {"size": size},
        "nodes": {"spacing": 0.5},
        "particles": {"centres": centres, "radii": radii},
    }
    return posted("overlaps", job(case))


def wrong_lists(r: random.Random) -> Nasty:
    """Lists of very many wrong items."""
    n = r.choice([10, 1000, 90_000])
    item = r.choice(["a", -1.0, None, [], [1.0], [[1.0, 2.0]], {"x": 1}, True, 1e308, [1.0, "y"]])
    key = r.choice(["radii", "centres", "sizes", "histogram"])
    case = {**TINY, "particles": {"centres": [[6.0, 6.0]], "radii": [5.0], key: [item] * n}}
    return posted("wrong lists", job(case))


def sweeps(r: random.Random) -> Nasty:
    """Products without end, axes that are none, points that cannot be."""
    n = r.choice([1, 3, 300, 3000])
    axes = r.choice(
        [
            {"time.end": {"linspace": [0.001, 0.002, 10**9]}},
            {f"k{k}": [1] for k in range(500)},
            {"time.end": [0.001 + 1e-9 * k for k in range(n)], "model.D_surf": [1.0 + k for k in range(n)]},
            {"time.end": {"low": 1, "high": 2}},
            {"time": [{"end": k} for k in range(1000)]},
            {"particles": [{}] * n},
            {"time.end": [-1.0] * n},
            {"": [1]},
            {".": [1]},
            {"a." * 1000: [1]},
            {"particles.path": ["/etc/passwd"]},
            {"model.D_surf": [float(k) for k in range(1000)]},
        ]
    )
    sample = r.choice(
        [{}, {"method": "sobol", "points": r.choice([7, 10**6, 10**12])}, {"replicates": 10**9}, {"method": "zip"}]
    )
    base = r.choice([TINY, PACKING, {}, "case.toml", {"particles": None}])
    return posted("sweeps", dumped({"definition": {"base": base, "axes": axes, "sample": sample}}), "/v1/sweeps")


# --- files


def hdf5() -> bytes:
    memory = io.BytesIO()
    with h5py.File(memory, "w") as file:
        file["nodes"] = np.arange(4.0)
    return memory.getvalue()


HDF5 = hdf5()
CONTENTS: list[bytes] = [
    b"*NODE, INPUT=/etc/passwd\n",
    b"*INCLUDE, INPUT=/dev/zero\n",
    HDF5,
    b"\0" * 512 + HDF5,
    b"\0" * 2048 + HDF5,
    b'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]>'
    b'<VTKFile type="UnstructuredGrid">&b;</VTKFile>',
    b'<Xdmf><Domain><Grid><DataItem Format="HDF">/etc/x.h5:/a</DataItem></Grid></Domain></Xdmf>',
    b'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "bbbbbbbbbb"><!ENTITY c "&b;&b;&b;&b;">]><VTKFile>&c;</VTKFile>',
    b"$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Nodes\n999999999 999999999 1 999999999\n",
    b"$MeshFormat\n2.2 1 8\n",
    b"# vtk DataFile Version 3.0\nx\nBINARY\nDATASET UNSTRUCTURED_GRID\nPOINTS 99999999999 double\n",
    b"NDIME= 2\nNELEM= 10\n",
    b"MeshVersionFormatted 2\nDimension 2\nVertices\n1000000000\n",
    b"x,y,radius\n" + b"1,2,3\n" * 100_000,
    b"",
    b"\0" * 100_000,
    b"x,y,radius\nnan,1,1\n",
    b"x,y,radius\n" + b"1," * 100_000,
    b"\xff\xfe",
    b"x,y,radius\n1e999,2,3\n",
]


def files(r: random.Random) -> Nasty:
    """Meshes and tables that lead elsewhere, or nowhere."""
    content = r.choice(CONTENTS)
    if r.random() < 0.3 and content:
        content = content[: r.randrange(len(content))]
    name = r.choice(["a", "../../a", "/etc/passwd", "a/b", "C:a", ".", "n" * 190, "a\u00e9"]) + r.choice(
        [".msh", ".inp", ".med", ".vtu", ".vtk", ".csv", ".mesh", ".su2", ".xdmf", ".h5", ".npz", ".pickle", ""]
    )
    encoding = r.choice(["base64", "base64", "text", "hex"])
    text = base64.b64encode(content).decode() if encoding == "base64" else content.decode("latin-1")
    path = r.choice([name, name, "/etc/passwd", "other.msh", ""])
    table = r.choice([("nodes", {"source": "file", "path": path}), ("particles", {"source": "file", "path": path})])
    case = {**TINY, table[0]: table[1]}
    return posted("files", job(case, files={name: {"content": text, "encoding": encoding}}))


# --- queries and paths


def queries(r: random.Random) -> Nasty:
    """Filters that are none, and too many of them."""
    key = r.choice(
        [
            "particles.mean_radius",
            "tag",
            "state",
            "sweep",
            "name",
            "k",
            "order",
            "cursor",
            "limit",
            "result.x",
            "result.packing.a.b",
            "particles.centres",
            "created",
            "%00",
            "a" * 3000,
        ]
    )
    verb = r.choice(["", ".ge", ".in", ".ne", ".like", ".eq.eq"])
    value = r.choice(
        ["1", "", "nan", "1e999", "queued,running", "x" * 3000, "%27%20OR%201=1", "%ff", "-1", "2**64", "9" * 40]
    )
    part = f"{key}{verb}={value}"
    return Nasty("queries", "GET", "/v1/jobs?" + "&".join([part] * r.choice([1, 2, 60, 1000]))[:60_000])


def paths(r: random.Random) -> Nasty:
    """Keys of stores, ids and ranges that are none."""
    key = r.choice(
        ["../../../frit.db", "..%2f..%2ffrit.db", "%00", "%ff", "a" * 5000, "rho/../../x", "//etc/passwd", "zarr.json"]
    )
    path = r.choice(
        [
            f"/v1/jobs/{{job}}/snapshots.zarr/{key}",
            f"/v1/jobs/{key}",
            f"/v1/sweeps/{key}",
            "/v1/jobs/{job}/log",
            "/v1/jobs/{job}/history",
            f"/v1/sweeps/s1/compare?observable={key}",
            "/v1/jobs/{job}",
        ]
    )
    ranges = r.choice(
        ["bytes=0-", "bytes=-0", "bytes=5-1", "bytes=0-0,1-1", "bytes=" + "9" * 40 + "-", "x", "bytes=-999999"]
    )
    headers = {
        "Range": ranges,
        "Accept": r.choice(["*/*", "text/csv", "q=" * 1000, ";;,,"]),
        "If-None-Match": r.choice(["*", '"']),
    }
    return Nasty(
        "paths",
        r.choice(["GET", "HEAD", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE"]),
        path,
        headers={**JSON, **headers},
    )


def changes(r: random.Random) -> Nasty:
    """Cancel and retry what may not be, with keys that are none."""
    key = r.choice(["a", "b", "x" * 300, " ", "\xff", "a,b", "ok"])
    body = r.choice([b"", b"{}", b"[]", b"x" * 1000, b"{" * 100_000])
    path = r.choice(["/v1/jobs/{job}/cancel", "/v1/jobs/{job}/retry", "/v1/jobs/none/cancel", "/v1/jobs/{sweep}/retry"])
    return posted("changes", body, path, headers={**JSON, "Idempotency-Key": key})


def good(r: random.Random) -> Nasty:
    """What everybody sends, between all that."""
    case = {**TINY, "model": {"D_surf": round(r.uniform(0.1, 8.0), 6)}}
    sent = posted("good", job(case, tags=["good"], priority=r.randint(-5, 5)))
    return r.choice([sent, Nasty("good", "GET", "/v1/jobs?limit=500"), Nasty("good", "GET", "/metrics")])


KINDS: list[Callable[[random.Random], Nasty]] = [
    stranger,
    names,
    tokens,
    torn,
    deep,
    many_values,
    many_keys,
    long_words,
    long_numbers,
    control_characters,
    values,
    too_much,
    overlaps,
    wrong_lists,
    sweeps,
    files,
    queries,
    paths,
    changes,
    good,
]


def nasties(seed: int, count: int) -> Iterator[Nasty]:
    """All kinds in turn, the same for the same seed."""
    r = random.Random(seed)
    for number in range(count):
        yield KINDS[number % len(KINDS)](r)
