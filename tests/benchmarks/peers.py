"""The same two discs by frit, py-pde, FiPy and plain differences: `python tests/benchmarks/peers.py [NAME ...]`.

Two touching discs of radius 20 nm in 100 x 60 nm without rigid motion, to t = 10 at spacing 1: how long one core
works, and how far the neck is from converged differences (17.33 nm). Compiling is told apart from working: it is paid
once. `pip install 'frit[peers]'` brings py-pde and FiPy; what is not installed is left out, and said.
"""

import importlib
import os
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", NUMBA_NUM_THREADS="1")

import numba
import numpy as np
from numpy.typing import NDArray

Field = NDArray[np.float64]
EXACT = 17.33  # nm, by differences at spacings 1/2 and 1/3
SIZE, RADIUS, XI, END = (100.0, 60.0), 20.0, 1.0, 10.0
CENTRES = ((30.0, 30.0), (70.0, 30.0))
A, B, L, KAPPA_RHO, KAPPA_ETA = 16.0, 1.0, 10.0, 10.0, 1.0
D_GB, D_VOL, D_SURF, D_VAP = 0.4, 0.01, 4.0, 0.001


class Result(NamedTuple):
    """Processor seconds of compiling and of the time loop, the neck at the end in nm, and how it was done."""

    compiling: float
    working: float
    neck: float
    how: str


def cells(h: float) -> tuple[Field, Field]:
    """Centres of the cells of a square grid."""
    x, y = (np.arange(0.5 * h, length, h) for length in SIZE)
    X, Y = np.meshgrid(x, y, indexing="ij")
    return X, Y


def initial(h: float) -> list[Field]:
    """rho, eta_1, eta_2 of (34) at the cell centres, (nx, ny) each."""
    X, Y = cells(h)
    eta = [0.5 * (1.0 - np.tanh((np.hypot(X - x, Y - y) - RADIUS) / XI)) for x, y in CENTRES]
    return [np.minimum(eta[0] + eta[1], 1.0), *eta]


def chord(rho: Field, h: float) -> float:
    """Length of rho > 1/2 on the line x = 50, linear between the cells beside it."""
    middle = rho.shape[0] // 2
    line = 0.5 * (rho[middle - 1] + rho[middle])
    y = (np.arange(line.size) + 0.5) * h
    inside = np.flatnonzero(line > 0.5)
    i, j = int(inside[0]), int(inside[-1])
    low = y[i] - h * (line[i] - 0.5) / (line[i] - line[i - 1])
    high = y[j] + h * (line[j] - 0.5) / (line[j] - line[j + 1])
    return float(high - low)


# --- plain differences, explicit Euler in numba


@numba.njit(fastmath={"reassoc", "contract", "arcp", "nsz"}, error_model="numpy")
def march(u: Field, W: Field, D: Field, new: Field, h: float, dt: float, steps: int) -> None:
    """Euler steps of the model on a square grid with mirrored walls; u (3, nx, ny)."""
    nx, ny = W.shape
    for _ in range(steps):
        for i in range(nx):
            for j in range(ny):
                r, a, b = u[0, i, j], u[1, i, j], u[2, i, j]
                S2, S3 = a * a + b * b, a * a * a + b * b * b
                i0, i1, j0, j1 = max(i - 1, 0), min(i + 1, nx - 1), max(j - 1, 0), min(j + 1, ny - 1)
                lap = (u[0, i0, j] + u[0, i1, j] + u[0, i, j0] + u[0, i, j1] - 4.0 * r) / (h * h)
                bulk = A * (4.0 * r**3 - 6.0 * r * r + 2.0 * r) + B * (2.0 * r - 6.0 * S2 + 4.0 * S3)
                W[i, j] = bulk - KAPPA_RHO * lap
                c = min(max(r, 0.0), 1.0)
                phi = c**3 * (10.0 - 15.0 * c + 6.0 * c * c)
                D[i, j] = D_VOL * phi + D_VAP * (1.0 - phi) + D_SURF * c * (1.0 - c)
                D[i, j] += 2.0 * D_GB * max(a, 0.0) * max(b, 0.0)
                for k in (1, 2):
                    e = u[k, i, j]
                    lap = (u[k, i0, j] + u[k, i1, j] + u[k, i, j0] + u[k, i, j1] - 4.0 * e) / (h * h)
                    drive = 12.0 * B * ((1.0 - r) * e - (2.0 - r) * e * e + e * S2)
                    new[k, i, j] = e - dt * L * (drive - KAPPA_ETA * lap)
        for i in range(nx):
            for j in range(ny):
                i0, i1, j0, j1 = max(i - 1, 0), min(i + 1, nx - 1), max(j - 1, 0), min(j + 1, ny - 1)
                flux = 0.0
                for p, q in ((i0, j), (i1, j), (i, j0), (i, j1)):
                    flux += 0.5 * (D[i, j] + D[p, q]) * (W[p, q] - W[i, j])
                new[0, i, j] = u[0, i, j] + dt * flux / (h * h)
        u[:] = new


def differences() -> Result:
    """Square grid of spacing 1, Euler at half the largest stable step."""
    h, dt = 1.0, 0.002
    u = np.array(initial(h))
    W, D, new = np.empty_like(u[0]), np.empty_like(u[0]), np.empty_like(u)
    start = time.process_time()
    march(u.copy(), W, D, new, h, dt, 1)
    compiled = time.process_time()
    march(u, W, D, new, h, dt, round(END / dt))
    return Result(compiled - start, time.process_time() - compiled, chord(u[0], h), "numba, explicit Euler, dt = 0.002")


# --- frit


def frit() -> Result:
    """Lattice of spacing 1, the default integrator at its default tolerance."""
    from bench import Loop, two_discs

    start = time.process_time()
    Loop(two_discs(time={"end": 0.01}))
    compiled = time.process_time()
    loop = Loop(two_discs(time={"end": END}))
    return Result(compiled - start, loop.seconds, loop.neck, f"adaptive, {loop.evaluations} evaluations")


# --- py-pde


def py_pde() -> Result:
    """Its numba backend on the same square grid, explicit, with its own step control."""
    pde = importlib.import_module("pde")
    h = 1.0
    grid = pde.CartesianGrid([(0.0, length) for length in SIZE], [round(length / h) for length in SIZE])
    fields = [pde.ScalarField(grid, values) for values in initial(h)]
    S2, S3 = "(a**2 + b**2)", "(a**3 + b**3)"
    W = f"({A} * (4 * r**3 - 6 * r**2 + 2 * r) + {B} * (2 * r - 6 * {S2} + 4 * {S3}) - {KAPPA_RHO} * laplace(r))"
    c = "inside(r)"
    phi = f"({c}**3 * (10 - 15 * {c} + 6 * {c}**2))"
    D = f"({D_VOL} * {phi} + {D_VAP} * (1 - {phi}) + {D_SURF} * {c} * (1 - {c}) + {2 * D_GB} * inside(a) * inside(b))"
    rates = {"r": f"{D} * laplace({W}) + dot(gradient({D}), gradient({W}))"}
    for eta in "ab":
        drive = f"12 * {B} * ((1 - r) * {eta} - (2 - r) * {eta}**2 + {eta} * {S2})"
        rates[eta] = f"-{L} * ({drive} - {KAPPA_ETA} * laplace({eta}))"

    def inside(value: Any) -> Any:
        return np.minimum(np.maximum(value, 0.0), 1.0)

    problem = pde.PDE(rates, bc={"derivative": 0}, user_funcs={"inside": inside})
    state = pde.FieldCollection(fields, labels=["r", "a", "b"])
    options: dict[str, Any] = {"dt": 0.002, "solver": "euler", "tracker": None, "backend": "numba"}
    start = time.process_time()
    problem.solve(state, t_range=0.002, **options)
    compiled = time.process_time()
    result = problem.solve(state, t_range=END, **options)  # finds what is compiled
    working = time.process_time() - compiled
    return Result(compiled - start, working, chord(result[0].data, h), "numba backend, explicit Euler, dt = 0.002")


# --- FiPy


def fipy() -> Result:
    """Finite volumes, rho and W coupled and linearised in each step, steps that grow with time; SciPy's solvers."""
    os.environ["FIPY_SOLVERS"] = "scipy"
    sys.argv = sys.argv[:1]  # FiPy reads the command line
    fp = importlib.import_module("fipy")
    h = 1.0
    mesh = fp.Grid2D(nx=round(SIZE[0] / h), ny=round(SIZE[1] / h), dx=h, dy=h)
    rho, one, two = (fp.CellVariable(mesh=mesh, value=values.T.ravel(), hasOld=True) for values in initial(h))
    W = fp.CellVariable(mesh=mesh, value=0.0)
    S2, S3 = one**2 + two**2, one**3 + two**3
    first = A * (4 * rho**3 - 6 * rho**2 + 2 * rho) + B * (2 * rho - 6 * S2 + 4 * S3)
    second = A * (12 * rho**2 - 12 * rho + 2) + 2 * B
    inside = (rho > 0.0) * (rho < 1.0) * rho + (rho >= 1.0)
    phi = inside**3 * (10 - 15 * inside + 6 * inside**2)
    gb = 2 * D_GB * (one > 0.0) * (two > 0.0) * one * two
    D = D_VOL * phi + D_VAP * (1 - phi) + D_SURF * inside * (1 - inside) + gb
    mass = fp.TransientTerm(var=rho) == fp.DiffusionTerm(coeff=D.arithmeticFaceValue, var=W)
    potential = fp.ImplicitSourceTerm(coeff=1.0, var=W) == (
        (first - second * rho)
        + fp.ImplicitSourceTerm(coeff=second, var=rho)
        - fp.DiffusionTerm(coeff=KAPPA_RHO, var=rho)
    )
    coupled = mass & potential
    grains = []
    for eta in (one, two):
        slope = 12 * B * ((1 - rho) - 2 * (2 - rho) * eta + S2 + 2 * eta**2)
        drive = 12 * B * ((1 - rho) * eta - (2 - rho) * eta**2 + eta * S2)
        grains.append(
            fp.TransientTerm(var=eta)
            == -L * (drive - slope * eta)
            - fp.ImplicitSourceTerm(coeff=L * slope, var=eta)
            + fp.DiffusionTerm(coeff=L * KAPPA_ETA, var=eta)
        )
    solver = fp.LinearLUSolver()
    start = time.process_time()
    now, dt, steps = 0.0, 1e-3, 0
    while now < END - 1e-9:
        dt = min(dt * 1.1, 0.1, END - now)
        for variable in (rho, one, two):
            variable.updateOld()
        for eta, equation in zip((one, two), grains, strict=True):
            equation.solve(var=eta, dt=dt, solver=solver)
        coupled.solve(dt=dt, solver=solver)
        now, steps = now + dt, steps + 1
    working = time.process_time() - start
    values = np.asarray(rho.value).reshape(round(SIZE[1] / h), round(SIZE[0] / h)).T
    return Result(0.0, working, chord(values, h), f"linearised implicit, {steps} steps up to 0.1")


PEERS: dict[str, Callable[[], Result]] = {"frit": frit, "differences": differences, "py-pde": py_pde, "FiPy": fipy}
MODULES = {"py-pde": "pde", "FiPy": "fipy"}


def main() -> None:
    """Run all, or those that are named, one after the other in this process."""
    chosen = sys.argv[1:] or list(PEERS)
    ours: Result | None = None
    print(f"{'':12}{'compiling':>10}{'working':>9}  {'neck, nm':>8}{'error':>9}{'time / frit':>13}{'error / frit':>14}")
    for name in chosen:
        if name in MODULES and importlib.util.find_spec(MODULES[name]) is None:
            print(f"{name:12}not installed: pip install 'frit[peers]'")
            continue
        found = PEERS[name]()
        ours = found if name == "frit" else ours
        error = found.neck / EXACT - 1.0
        ratios = ""
        if ours is not None:
            ratios = f"{found.working / ours.working:13.2f}{abs(error / (ours.neck / EXACT - 1.0)):14.2f}"
        times = f"{found.compiling:9.1f}s{found.working:8.2f}s"
        print(f"{name:12}{times}  {found.neck:8.3f}{error:9.2%}{ratios}  {found.how}")


if __name__ == "__main__":
    main()
