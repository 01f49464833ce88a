"""`frit plot`, `frit movie`: pictures of one run."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .terminal import refuse

if TYPE_CHECKING:
    from frit.sweeps.pictures import Look

RunDirectory = Annotated[Path, typer.Argument(metavar="DIR", exists=True, file_okay=False)]
Colour = Annotated[str, typer.Option(metavar="WHAT", help="particle, radius, rho or boundary.")]
Sections = Annotated[bool, typer.Option("--sections", help="Of spheres three mid-planes, not the surface.")]


def plot(
    directory: RunDirectory,
    time: Annotated[
        float | None, typer.Option(metavar="T", help="Model time; the nearest snapshot is shown.")
    ] = None,
    panel: Annotated[
        str | None, typer.Option(metavar="T,T,...", help="Several snapshots in one figure, as 0,1,end.")
    ] = None,
    colour: Colour = "particle",
    sections: Sections = False,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE.png", dir_okay=False, help="Default: in DIR; .pdf, .svg too.")
    ] = None,
) -> None:
    """Picture of the snapshot nearest to --time, or of those at --panel; of the history without them."""
    from frit.sweeps import pictures, plots

    if time is not None and panel is not None:
        refuse("--panel: give either this or --time")
    look = looked(colour, sections)
    try:
        if time is None and panel is None:
            out = out or directory / "history.png"
            plots.plot_history(directory, out)
            typer.echo(f"{out}: history")
            return
        asked = [time] if time is not None else times_of(panel or "", plots.snapshot_times(directory))
        found = [plots.nearest_time(directory, t) for t in asked]
        out = out or directory / ("panels.png" if panel is not None else f"snapshot-{found[0]:g}.png")
        shown = pictures.draw_panels(directory, asked, out, look)
        for t in asked:
            if said := plots.far_away(directory, t):
                typer.echo(f"note: {said}", err=True)
        typer.echo(f"{out}: snapshot at t = {', '.join(f'{t:g}' for t in shown)}")
    except (ValueError, OSError) as error:
        refuse(str(error))


def movie(
    directory: RunDirectory,
    colour: Colour = "particle",
    sections: Sections = False,
    frames: Annotated[int, typer.Option(metavar="N", min=1, max=60, help="Snapshots in a second.")] = 10,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", dir_okay=False, help="Default: in DIR; .gif, with ffmpeg .mp4.")
    ] = None,
) -> None:
    """All snapshots of a run, one after the other."""
    from frit.sweeps import pictures

    look = looked(colour, sections)
    try:
        typer.echo(f"{pictures.movie(directory, out, look, frames)}: movie")
    except (ValueError, OSError) as error:
        refuse(str(error))


def looked(colour: str, sections: bool) -> "Look":
    """How to draw, from the command line."""
    from frit.sweeps import pictures

    for known in pictures.COLOURS:
        if colour == known:
            return pictures.Look(known, sections)
    refuse(f"--colour {colour}: must be one of {', '.join(pictures.COLOURS)}")


def times_of(text: str, known: list[float]) -> list[float]:
    """Model times between commas; "end" is that of the last snapshot."""
    try:
        return [known[-1] if word.strip() == "end" else float(word) for word in text.split(",")]
    except ValueError:
        refuse(f"--panel {text}: must be model times between commas, as 0,1,end")
