"""`mrcdrl render`: make a film of evaluation episodes, or a recording for rerun's viewer."""

from collections.abc import Sequence
from pathlib import Path

from mrcdrl.services.plots.figures import check_suffix
from mrcdrl.services.plots.film import SUFFIXES, write_film
from mrcdrl.services.tools.episode_frames import film_frames
from mrcdrl.services.tools.rerun_recording import SUFFIX, check_rerun, write_recording
from mrcdrl.services.tools.subject import parse_with_episodes, subject, subject_parser

FPS = 30


def main(argv: Sequence[str]) -> int:
    """Write the film or recording; return the exit code."""
    parser = subject_parser("render", "Make a film of evaluation episodes.")
    parser.add_argument(
        "--out", type=Path, default=Path("film.mp4"), help=f"the .mp4, .gif or {SUFFIX} to write"
    )
    arguments = parse_with_episodes(parser, argv, 4)
    check_suffix(arguments.out, (*SUFFIXES, SUFFIX))
    recorded = arguments.out.suffix == SUFFIX
    if recorded:
        check_rerun()
    shown = subject(arguments)
    arena = shown.config.arena
    results = shown.episodes(arguments.episodes, arguments.seed)
    if recorded:
        write_recording(arguments.out, arena, results)
    else:
        write_film(arguments.out, film_frames(arena, results), FPS)
    return 0
