"""`mrcdrl render`: a film of evaluation episodes, the robots' own views beside the arena."""

from collections.abc import Sequence
from pathlib import Path

from common.arena import test_starts
from services.dashboard.film import check_suffix, write_film
from services.evaluator.film import film_frames
from services.evaluator.subject import subject, subject_parser
from services.evaluator.trial import play

FPS = 30


def main(argv: Sequence[str]) -> int:
    """Write the film; the exit code."""
    parser = subject_parser("render", "A film of evaluation episodes.")
    parser.add_argument(
        "--out", type=Path, default=Path("film.mp4"), help="the .mp4 or .gif to write"
    )
    parser.add_argument("--episodes", type=int, default=4, help="episodes to show")
    parser.add_argument("--seed", type=int, default=0, help="of the starts and the exploration")
    arguments = parser.parse_args(argv)
    if arguments.episodes < 1:
        parser.error(f"--episodes {arguments.episodes}: at least 1")
    check_suffix(arguments.out)
    shown = subject(arguments)
    arena = shown.config.arena
    starts = test_starts(arena, arguments.episodes, arguments.seed)
    results = play(arena, starts, shown.player(arguments.seed), keep_paths=True)
    write_film(arguments.out, film_frames(arena, results or []), FPS)
    return 0
