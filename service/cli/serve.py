"""`frit serve`."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from .terminal import DataFolder, refuse

SWITCH = 5e-4  # seconds that a thread which checks a large case keeps the event loop waiting at a time


def serve(
    data: DataFolder = Path("data"),
    cores: Annotated[int | None, typer.Option(metavar="N", min=1, help="Processors for jobs; default: all.")] = None,
    host: Annotated[str, typer.Option(envvar="FRIT_HOST", help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(envvar="FRIT_PORT", min=0, max=65535, help="0: any free one.")] = 8000,
    access_log: Annotated[bool, typer.Option("--access-log", help="A line on stderr per request.")] = False,
    release: Annotated[
        bool | None, typer.Option("--release/--leave", help="At the end: stop running jobs, with a checkpoint.")
    ] = None,
) -> None:
    """Serve jobs over HTTP. Ending the service leaves its jobs running; the next one takes them up again.

    With --release (or FRIT_RELEASE=1) they write a checkpoint, end and wait in the queue: where nothing outlives it.
    """
    import uvicorn
    from pydantic import ValidationError

    from ..http.app import create_app
    from ..http.security import AddressError, check
    from ..http.wire import options
    from ..jobs.engine import EngineError
    from ..jobs.memory import keep_little
    from ..settings import Settings

    chosen = {"cores": cores, "release": release}
    given = {"data": data, "host": host, "port": port, **{k: v for k, v in chosen.items() if v is not None}}
    try:
        settings = Settings.model_validate(Settings().model_dump() | given)
        warning = check(settings)
    except ValidationError as error:
        refuse(*(f"FRIT_{'_'.join(map(str, e['loc'])).upper()} = {e['input']!r}: {e['msg']}" for e in error.errors()))
    except (EngineError, AddressError) as error:
        refuse(str(error))
    typer.echo(f"frit serves {settings.data.absolute()} with {settings.cores} cores", err=True)
    if warning is not None:
        typer.echo(warning, err=True)
    sys.setswitchinterval(SWITCH)
    keep_little()
    uvicorn.run(create_app(settings), host=host, port=port, access_log=access_log, **options(settings))
