"""What to send to the service, and what came back in short."""

from typing import Any

from asking import TINY
from fastapi.testclient import TestClient

Tree = dict[str, Any]
SWEEP: Tree = {"name": "two", "base": {**TINY, "name": "sleep 0"}, "axes": {"model.D_surf": [2.0, 4.0]}}


def case(name: str, shift: float = 0.0) -> Tree:
    centres = [[6.5, 6.2], [15.4 + shift, 6.8]]
    return {**TINY, "name": name, "particles": {**TINY["particles"], "centres": centres}}


def upload(client: TestClient, content: bytes, name: str = "mesh.msh", **headers: str) -> Any:
    headers = {"Content-Type": "application/octet-stream", **headers}
    return client.post("/v1/files", params={"name": name}, content=content, headers=headers)


def kind(answer: Any) -> tuple[int, str]:
    return answer.status_code, answer.json()["type"].rpartition("/")[2]
