"""The image: what its files promise, and, slow, the image itself, built by buildah and put to work."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx2
import pytest
import yaml
from asking import LONG, TINY, free_port
from places import ROOT

from frit.service.client import Client
from frit.service.http.app import create_app
from frit.service.jobs.launch import kill_marked
from frit.service.settings import Settings
from frit.solver.durable import read_json

DOCKERFILE = (ROOT / "docker" / "Dockerfile").read_text()
COMPOSE = yaml.safe_load((ROOT / "docker" / "compose.yaml").read_text())
TIMEOUT = 300.0  # seconds; there for hangs


def instructions(name: str) -> list[str]:
    """What stands behind each instruction of this name, in one line each."""
    lines = re.sub(r"^\s*#.*\n", "", DOCKERFILE, flags=re.MULTILINE).replace("\\\n", " ").splitlines()
    return [line.split(None, 1)[1] for line in lines if line.startswith(name + " ")]


def environment() -> dict[str, str]:
    return dict(re.findall(r"(\w+)=(\S+)", " ".join(instructions("ENV"))))


def health_check() -> list[str]:
    """The command of the health check."""
    (check,) = instructions("HEALTHCHECK")
    command: list[str] = json.loads(check[check.index("[") :])
    return command


# --- what costs nothing -----------------------------------------------------------------------------------


def test_what_is_copied_exists_and_is_in_the_context() -> None:
    sources = [word for line in instructions("COPY") if "--from" not in line for word in line.split()[:-1]]
    named = [re.sub(r"\$\{WHEELHOUSE:-(.*)\}", r"\1", word) for word in sources]
    assert {"solver", "service", "sweeps", "pyproject.toml"} <= set(named)
    ignored = (ROOT / ".dockerignore").read_text().split()
    for name in named:
        assert (ROOT / name).exists()
        assert name not in ignored


def test_every_package_of_frit_is_copied() -> None:
    tree = tomllib.loads((ROOT / "pyproject.toml").read_text())
    folders = set(tree["tool"]["setuptools"]["package-dir"].values())
    assert {folder.split("/")[0] for folder in folders} <= {
        word for line in instructions("COPY") for word in line.split()
    }


def test_the_health_check_asks_a_route_that_needs_no_token(tmp_path: Path) -> None:
    (path,) = re.findall(r"http://127\.0\.0\.1:\{[^}]*\}(/\w+)", health_check()[-1])
    operation = create_app(Settings(data=tmp_path)).openapi()["paths"][path]["get"]
    assert "security" not in operation
    assert f"http://127.0.0.1:{{os.environ['FRIT_PORT']}}{path}" in health_check()[-1]
    assert "FRIT_PORT" in environment()


def test_the_environment_of_the_image_is_a_setting_or_known_to_the_solver(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in environment().items():
        monkeypatch.setenv(name, value)
    settings = Settings()
    assert (settings.host, settings.data, settings.release) == ("0.0.0.0", Path("/data"), True)
    own = {name.removeprefix("FRIT_").lower() for name in environment() if name.startswith("FRIT_")}
    assert own - set(Settings.model_fields) == {"cache_dir", "cache_seed"}


def test_nothing_runs_as_root_and_the_data_are_a_volume() -> None:
    assert instructions("USER") == ["frit"]
    assert instructions("VOLUME") == ["/data"]
    assert DOCKERFILE.index("\nUSER frit") < DOCKERFILE.index("\nENTRYPOINT")


def test_compose_gives_jobs_the_time_that_the_image_says_they_need() -> None:
    service = COMPOSE["services"]["frit"]
    grace = int(service["stop_grace_period"].removesuffix("s"))
    assert grace > 2 * float(environment()["FRIT_GRACE"])  # a checkpoint, the end
    assert service["init"] is True
    assert service["volumes"] == ["data:/data"]
    assert "data" in COMPOSE["volumes"]
    assert (ROOT / "docker" / service["build"]["context"] / service["build"]["dockerfile"]).exists()
    arguments = {line.split("=")[0] for line in instructions("ARG")}
    assert set(service["build"]["args"]) <= arguments


def test_compose_publishes_the_port_of_the_image_on_this_machine_only() -> None:
    (port,) = COMPOSE["services"]["frit"]["ports"]
    address, _, inside = port.rsplit(":", 2)
    assert address == "127.0.0.1"
    assert [inside] == instructions("EXPOSE") == [environment()["FRIT_PORT"]]


# --- the image itself -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Image:
    """An image, a container of it, and where its root file system lies."""

    buildah: list[str]
    container: str
    root: Path
    config: dict[str, Any]

    def command(self, data: Path, *words: str, **environment: str) -> list[str]:
        """A command line that runs something in the container, as its user, with its environment."""
        given = [part for name, value in environment.items() for part in ("--env", f"{name}={value}")]
        return [
            *self.buildah, "run", "--isolation", "chroot", *given, "--volume", f"{data}:/data", self.container, "--",
            *words,
        ]  # fmt: skip

    def run(self, data: Path, *words: str, **environment: str) -> str:
        """What it prints."""
        return said(self.command(data, *words, **environment))


def said(command: list[str]) -> str:
    """Run to the end; a failure shows all that was said."""
    done = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    assert done.returncode == 0, f"{' '.join(command)}: {done.returncode}\n{done.stdout[-4000:]}\n{done.stderr[-4000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Image]:
    """Built on a bare Debian, from wheels of the versions that the tests run with; gone afterwards."""
    if missing := [name for name in ("buildah", "debootstrap") if shutil.which(name) is None]:
        reason = f"{' and '.join(missing)} not found: apt-get install --no-install-recommends buildah debootstrap"
        if os.environ.get("FRIT_REQUIRE_ALL") == "1":
            pytest.fail(reason)
        pytest.skip(reason)
    folder = tmp_path_factory.mktemp("image")
    places = ["--root", str(folder / "storage"), "--runroot", str(folder / "state")]
    buildah = ["buildah", *places, "--storage-driver", "vfs"]
    context = folder / "context"
    try:
        make_base(buildah, folder / "base")
        shutil.copytree(ROOT, context, ignore=shutil.ignore_patterns(*ignored()), symlinks=True)
        fill_wheelhouse(context / "wheelhouse", folder)
        arguments = {"BASE": "localhost/base", "WHEELHOUSE": "wheelhouse"}
        given = [part for name, value in arguments.items() for part in ("--build-arg", f"{name}={value}")]
        file = str(context / "docker" / "Dockerfile")
        build = ["bud", "--isolation", "chroot", "--format", "docker", "--tag", "frit", "--file", file]
        said([*buildah, *build, *given, str(context)])
        shutil.rmtree(context)
        container = said([*buildah, "from", "--pull-never", "localhost/frit"]).strip()
        said([*buildah, "config", "--volume", "/data-", container])  # or buildah puts a folder of its own there
        root = Path(said([*buildah, "mount", container]).strip())
        config = json.loads(said([*buildah, "inspect", "--type", "image", "localhost/frit"]))["Docker"]["config"]
        yield Image(buildah, container, root, config)
    finally:
        subprocess.run([*buildah, "rm", "--all"], capture_output=True)
        subprocess.run([*buildah, "rmi", "--all", "--force"], capture_output=True)
        shutil.rmtree(folder, ignore_errors=True)


def ignored() -> list[str]:
    """The names that stay out of the context."""
    lines = (ROOT / ".dockerignore").read_text().splitlines()
    return [line.removeprefix("**/") for line in lines if line and not line.startswith("#")]


def make_base(buildah: list[str], folder: Path) -> None:
    """Debian 12 with Python, as localhost/base."""
    said(["debootstrap", "--variant=minbase", "--include=python3,python3-venv", "bookworm", str(folder)])
    container = said([*buildah, "from", "scratch"]).strip()
    said([*buildah, "add", "--quiet", container, str(folder), "/"])
    said([*buildah, "commit", "--quiet", "--rm", container, "localhost/base"])
    shutil.rmtree(folder)


def fill_wheelhouse(folder: Path, beside: Path) -> None:
    """Every wheel that frit and its build need, in the versions that are installed here."""
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    (beside / "constraints").write_text(said([*pip, "freeze", "--exclude", "frit"]))
    tree = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wanted = [*tree["project"]["dependencies"], *tree["build-system"]["requires"]]
    constraints = ["--constraint", str(beside / "constraints")]
    said([*pip, "download", "--quiet", "--only-binary", ":all:", "--dest", str(folder), *constraints, *wanted])


@pytest.fixture
def data(tmp_path: Path, image: Image) -> Path:
    """A volume: what the image has in /data, nothing, of its user."""
    folder, uid = tmp_path / "data", (image.root / "data").stat().st_uid
    folder.mkdir()
    os.chown(folder, uid, uid)
    for parent in (tmp_path, tmp_path.parent, tmp_path.parent.parent):  # pytest's are closed to other users
        parent.chmod(0o755)
    return folder


def compiled(folder: Path) -> dict[str, bytes]:
    """Every file of compiled code below."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*.nb?")}


def until(happened: Any) -> None:
    """Wait; the limit is there for hangs."""
    deadline = time.monotonic() + TIMEOUT
    while not happened():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.slow
def test_the_image_says_how_to_run_it(image: Image) -> None:
    config = image.config
    assert (config["User"], config["WorkingDir"], list(config["Volumes"])) == ("frit", "/data", ["/data"])
    assert (config["Entrypoint"], config["Cmd"], config["StopSignal"]) == (["frit"], ["serve"], "SIGTERM")
    assert config["Healthcheck"]["Test"] == ["CMD", *health_check()]


@pytest.mark.slow
def test_the_user_owns_the_data_and_nothing_else(image: Image, data: Path) -> None:
    uid = (image.root / "data").stat().st_uid
    assert uid != 0
    assert image.run(data, "id", "-u").strip() == str(uid)
    installed = image.root / "opt" / "frit"
    assert {path.lstat().st_uid for path in installed.rglob("*")} == {0}
    assert not [path for path in installed.rglob("*") if not path.is_symlink() and path.stat().st_mode & 0o022]
    assert not (image.root / "build").exists()
    assert not (image.root / "wheels").exists()


@pytest.mark.slow
def test_without_a_token_the_service_refuses_and_says_how_to_make_one(image: Image, data: Path) -> None:
    done = subprocess.run(image.command(data, "frit", "serve"), capture_output=True, text=True)
    assert done.returncode == 2
    assert "frit token create --name NAME --scope submit --data /data" in done.stderr


@pytest.mark.slow
def test_the_service_solves_without_compiling_and_leaves_a_checkpoint_when_it_is_stopped(
    image: Image, data: Path
) -> None:
    token = image.run(data, "frit", "token", "create", "--name", "me", "--scope", "submit").strip()
    port = free_port()
    service = image.command(data, "frit", "serve", "--cores", "1", FRIT_PORT=str(port), FRIT_FREE_DISK="0")
    url = f"http://127.0.0.1:{port}"
    with subprocess.Popen(service, stdin=subprocess.DEVNULL) as process:
        try:
            until(lambda: process.poll() is not None or answers(url))
            assert process.poll() is None, "the service has ended"
            image.run(data, *health_check(), FRIT_PORT=str(port))
            assert httpx2.get(f"{url}/v1/jobs").status_code == 401
            with Client(url, token) as client:
                job = client.submit(TINY).wait(TIMEOUT)
                assert job.data["state"] == "succeeded", job.data
                assert compiled(data / ".cache") == compiled(image.root / "opt" / "frit" / "compiled") != {}
                long = client.submit(LONG)
                until(lambda: read_json(data / "runs" / long.id / "progress.json").get("step", 0) > 0)
            os.kill(int((data / "lock").read_text()), signal.SIGTERM)
            process.wait(TIMEOUT)
        finally:
            left = kill_marked(f"FRIT_PORT={port}")
    assert not left
    directory = data / "runs" / long.id
    assert json.loads((directory / "run.json").read_text())["state"] == "interrupted"
    assert (directory / "checkpoint.h5").stat().st_size > 0
    assert json.loads((directory / "exit.json").read_text())["move"] == "release"


def answers(url: str) -> bool:
    try:
        return httpx2.get(f"{url}/readyz").status_code == 200
    except httpx2.TransportError:
        return False


@pytest.mark.slow
def test_the_root_file_system_may_be_read_only(image: Image, data: Path) -> None:
    (data / "case.json").write_text(json.dumps(TINY))
    script = """
    set -e
    mount --bind "$ROOT" "$ROOT"
    mount --bind "$DATA" "$ROOT/data"
    mount -t tmpfs tmpfs "$ROOT/tmp"
    mount -t tmpfs tmpfs "$ROOT/dev"
    mkdir "$ROOT/dev/shm"
    chmod 1777 "$ROOT/dev/shm" "$ROOT/tmp"
    for device in null zero urandom; do touch "$ROOT/dev/$device"; mount --bind "/dev/$device" "$ROOT/dev/$device"; done
    mount -t proc proc "$ROOT/proc"
    mount -o remount,bind,ro "$ROOT"
    ! touch "$ROOT/opt/frit/x"
    exec env -i $ENVIRONMENT chroot --userspec=frit "$ROOT" frit run /data/case.json --ranks 2 --out /data/tiny
    """
    given = {"ROOT": str(image.root), "DATA": str(data), "ENVIRONMENT": " ".join(image.config["Env"])}
    command = ["unshare", "--mount", "--propagation", "private", "bash", "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | given)
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads((data / "tiny" / "run.json").read_text())["state"] == "succeeded"
    assert compiled(data / ".cache") == compiled(image.root / "opt" / "frit" / "compiled")
