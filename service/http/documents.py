"""`/` and `/docs`: pages that need no script and no network."""

from collections.abc import Iterator
from html import escape
from typing import Any

from fastapi import FastAPI
from fastapi.responses import HTMLResponse

METHODS = ("get", "post", "put", "patch", "delete")
STYLE = "body{font:15px sans-serif;max-width:60em;margin:2em auto}code,pre{background:#eee}dt{margin-top:1em}"
HOME = """<p>This is a job service of frit, which simulates the sintering of particle packings.</p>
<pre>frit submit case.toml --wait
frit jobs
frit top</pre>
<p>In Python: <code>from frit.service import Client; Client().submit("case.toml").wait().history()</code>.</p>
<p>By HTTP: <a href="/docs">/docs</a> has all routes, <a href="/openapi.json">/openapi.json</a> is for programs.</p>"""


def expose(app: FastAPI) -> None:
    """Add both to the app."""

    @app.get("/", include_in_schema=False)
    async def home() -> HTMLResponse:
        return page("frit", HOME)

    @app.get("/docs", include_in_schema=False)
    async def docs() -> HTMLResponse:
        return page("frit: HTTP interface", "".join(operations(app.openapi())))


def page(title: str, body: str) -> HTMLResponse:
    """A whole page."""
    head = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>'
    return HTMLResponse(f"{head}<h1>{title}</h1>{body}</html>")


def operations(document: dict[str, Any]) -> Iterator[str]:
    """The routes of an OpenAPI document, with what they take and answer."""
    yield f"<p>{escape(document['info']['description'])}</p><dl>"
    for path, methods in document["paths"].items():
        for method in METHODS:
            if (operation := methods.get(method)) is not None:
                yield f"<dt><b>{method.upper()}</b> <code>{escape(path)}</code></dt><dd>{told(operation)}</dd>"
    yield "</dl>"


def told(operation: dict[str, Any]) -> str:
    """What a route does, its parameters, its body and its answers."""
    words = [f"<p>{escape(operation.get('description') or operation.get('summary', ''))}</p>"]
    parameters = [
        f"<li><code>{escape(each['name'])}</code> ({each['in']}) {escape(each.get('description', ''))}</li>"
        for each in operation.get("parameters", ())
    ]
    words += ["<ul>", *parameters, "</ul>"] if parameters else []
    bodies = operation.get("requestBody", {}).get("content", {})
    names = [str(body.get("schema", {}).get("$ref", kind)).rpartition("/")[2] for kind, body in bodies.items()]
    words += [f"<p>Body: <code>{escape(name)}</code></p>" for name in names]
    return "".join([*words, f"<p>Answers: {', '.join(operation['responses'])}</p>"])
