"""`mrcdrl render`: make a film of evaluation episodes, or a recording for rerun's viewer."""

from collections.abc import Sequence
from pathlib import Path

from mrcdrl.common.arena import test_starts
from mrcdrl.services.evaluator.trial import play
from mrcdrl.services.plots.figures import check_suffix
from mrcdrl.services.plots.film import SUFFIXES, write_film
from mrcdrl.services.tools.episode_frames import film_frames
from mrcdrl.services.tools.rerun_recording import SUFFIX, check_rerun, write_recording
from mrcdrl.services.tools.subject import subject, subject_parser

FPS = 30


def main(argv: Sequence[str]) -> int:
    """Write the film or recording; return the exit code."""
    parser = subject_parser("render", "Make a film of evaluation episodes.")
    parser.add_argument(
        "--out", type=Path, default=Path("film.mp4"), help=f"the .mp4, .gif or {SUFFIX} to write"
    )
    parser.add_argument("--episodes", type=int, default=4, help="episodes to show")
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of the starts and the exploration"
    )
    arguments = parser.parse_args(argv)
    if arguments.episodes < 1:
        parser.error(f"--episodes {arguments.episodes}: at least 1")
    check_suffix(arguments.out, (*SUFFIXES, SUFFIX))
    recorded = arguments.out.suffix == SUFFIX
    if recorded:
        check_rerun()
    shown = subject(arguments)
    arena = shown.config.arena
    starts = test_starts(arena, arguments.episodes, arguments.seed)
    results = play(arena, starts, shown.player(arguments.seed), keep_paths=True) or []
    if recorded:
        write_recording(arguments.out, arena, results)
    else:
        write_film(arguments.out, film_frames(arena, results), FPS)
    return 0
