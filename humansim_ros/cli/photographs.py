"""``humansim human fit`` and ``texture``: a human from calibrated photographs."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from humansim_ros.cli import completion
from humansim_ros.cli.output import check_output, print_text
from humansim_ros.errors import HumansimError

if TYPE_CHECKING:
    from humansim_ros.photographs.person_fit import PersonFit
    from humansim_ros.photographs.views import PhotoSet

ViewsArgument = Annotated[
    Path, typer.Argument(metavar="VIEWS", help="Views file (.yaml): docs/from_photographs.md.")
]


class Method(Enum):
    """Choices of ``texture --method``."""

    atlas = "atlas"
    thesis = "thesis"


def fit(
    views: ViewsArgument,
    output: Annotated[Path, typer.Option("--output", "-o", help="Fit to write (.yaml).")],
    human: Annotated[
        str | None,
        typer.Option(
            help="Human to start from, instead of that of the views file.", autocompletion=completion.humans
        ),
    ] = None,
    detector: Annotated[
        str | None,
        typer.Option(
            help="Command that finds the 2D points of an image: 'python detect.py {image} {points}'; "
            "its results are kept in <name of the views file>_points."
        ),
    ] = None,
    silhouettes: Annotated[
        bool, typer.Option("--silhouettes/--no-silhouettes", help="Use the masks of the views.")
    ] = True,
    report: Annotated[
        Path | None, typer.Option(help="Picture of the fit (.png): overlays and residuals.")
    ] = None,
    bvh: Annotated[Path | None, typer.Option(help="Motion of a sequence to write (.bvh).")] = None,
    npz: Annotated[Path | None, typer.Option(help="Fitted human without a new texture (.npz).")] = None,
) -> None:
    """Fit a human to calibrated photographs: pose, place, stature, proportions."""
    from humansim_ros.humans.human import write_human
    from humansim_ros.motion.bvh import write_bvh
    from humansim_ros.photographs.detector import detect_points
    from humansim_ros.photographs.fit_file import write_fit
    from humansim_ros.photographs.fitting import fit_person
    from humansim_ros.photographs.sequence import fit_motion
    from humansim_ros.photographs.views import read_views

    _check(output, ".yaml", "a fit")
    _check(report, ".png", "the picture")
    _check(bvh, ".bvh", "a motion")
    _check(npz, ".npz", "a human")
    photos = read_views(views)
    if detector is not None:
        photos = detect_points(photos, detector, _print_progress)
    found = fit_person(photos, human, silhouettes=silhouettes, progress=_print_step)
    write_fit(output, found)
    print_text("\n".join(_lines(found, photos)))
    print_text(f"wrote {output}")
    if report is not None:
        from humansim_ros.drawing.canvas import write_png
        from humansim_ros.photographs.fit_report import draw_report

        # of a sequence, another fit would take long
        masks = any(photo.mask_path is not None for photo in photos.frames[0])
        compared = silhouettes and masks and len(photos.frames) == 1
        before = fit_person(photos, human, silhouettes=False) if compared else None
        write_png(report, draw_report(found, photos, before))
        print_text(f"wrote {report}")
    if bvh is not None:
        write_bvh(bvh, fit_motion(found))
        print_text(
            f"wrote {bvh}; in a scene, motion: {{file: {bvh.name}, anchor: file}} plays it in its place"
        )
    if npz is not None:
        write_human(npz, found.body)
        print_text(f"wrote {npz}")


def texture(
    views: ViewsArgument,
    fit_file: Annotated[Path, typer.Option("--fit", help="Fit of these views, of `humansim human fit`.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Human to write (.npz).")],
    method: Annotated[
        Method,
        typer.Option(
            help="atlas: one blended texture with aligned colours and filled gaps; thesis: for each face the "
            "photograph that sees it best."
        ),
    ] = Method.atlas,
    size: Annotated[
        int, typer.Option(min=64, max=8192, help="Side of the texture of --method atlas, pixels.")
    ] = 2048,
    frame: Annotated[
        list[int] | None,
        typer.Option(min=0, help="Number of a frame to use; may be repeated. The first if absent."),
    ] = None,
    report: Annotated[
        Path | None, typer.Option(help="Picture of the result (.png): all sides, texture, cameras.")
    ] = None,
) -> None:
    """Texture a fitted human from the photographs."""
    from humansim_ros.humans.human import write_human
    from humansim_ros.photographs.fit_file import read_fit
    from humansim_ros.photographs.texturing import texture_person
    from humansim_ros.photographs.views import read_views

    _check(output, ".npz", "a human")
    _check(report, ".png", "the picture")
    photos, fitted = read_views(views), read_fit(fit_file)
    textured = texture_person(fitted, photos, method.value, frames=tuple(frame or (0,)), size=size)
    write_human(output, textured.human)
    seen = float(textured.seen.mean())
    print_text(f"{textured.human.name}: {seen:.0%} of the faces are seen by a camera")
    print_text(f"wrote {output}")
    if report is not None:
        from humansim_ros.drawing.canvas import write_png
        from humansim_ros.photographs.texture_sheet import draw_sheet

        write_png(report, draw_sheet(textured))
        print_text(f"wrote {report}")


def _lines(fit: PersonFit, photos: PhotoSet) -> list[str]:
    """Facts about a fit for people."""
    import numpy as np

    used = fit.residuals[~fit.outliers & np.isfinite(fit.residuals)]
    stature, count = float(np.ptp(fit.body.mesh.vertices[:, 1])), len(fit.root)
    lines = [
        f"{count} frame{'s' if count > 1 else ''}, {len(fit.views)} views; {stature:.2f} m tall",
        f"points: {np.median(used):.1f} px from the photographs (median), 95% within "
        f"{np.percentile(used, 95):.1f} px; {int(fit.outliers.sum())} left out"
        if len(used)
        else "no points",
    ]
    if any(photo.mask_path is not None for photo in photos.frames[0]):
        from humansim_ros.photographs.silhouettes import silhouette_iou

        overlap = silhouette_iou(fit, photos, 0)
        lines.append("silhouettes: " + ", ".join(f"{name} {value:.3f}" for name, value in overlap.items()))
    return lines


def _print_step(step: str, done: int, count: int) -> None:
    """Progress of a sequence; a single frame is quick."""
    if count > 1 and (done == count or done % 25 == 0):
        print_text(f"{step}: {done} of {count} frames")


def _print_progress(done: int, count: int) -> None:
    if done == count or done % 10 == 0:
        print_text(f"detector: {done} of {count} images")


def _check(output: Path | None, suffix: str, what: str) -> None:
    """Raise HumansimError if a file cannot be written; before the work begins."""
    if output is None:
        return
    if output.suffix.lower() not in ((".yaml", ".yml") if suffix == ".yaml" else (suffix,)):
        raise HumansimError(f"{what} is written to a {suffix} file: give it this suffix", path=output)
    check_output(output)


#: Commands of this module by name.
COMMANDS: dict[str, Callable[..., None]] = {"fit": fit, "texture": texture}
