"""`mrcdrl report RUN`: write training.png, trajectories.png and evaluation.mp4 of a run."""

from collections.abc import Sequence
from pathlib import Path

from mrcdrl.common.config.arguments import Parser
from mrcdrl.common.errors import RunDirectoryError
from mrcdrl.services.evaluator.trial import EpisodeResult
from mrcdrl.services.plots.figures import Path2D, training_curve, trajectories
from mrcdrl.services.plots.film import write_film
from mrcdrl.services.tools.episode_frames import film_frames
from mrcdrl.services.tools.render import FPS
from mrcdrl.services.tools.subject import subject, subject_parser

_EPISODES = 12
_FILMED = 4
_SEED = 0


def main(argv: Sequence[str]) -> int:
    """Write the plots and the film; return the exit code."""
    parser = Parser(prog="mrcdrl report", description="Write the plots and the film of a run.")
    parser.add_argument("run", type=Path, help="the run directory")
    run_dir: Path = parser.parse_args(argv).run
    if not run_dir.is_dir():
        raise RunDirectoryError(f"{run_dir} is not a directory")
    training_curve(run_dir, run_dir / "training.png")
    draw_episodes(run_dir)
    return 0


def draw_episodes(run_dir: Path) -> None:
    """Plot and film episodes of the best weights; CheckpointError if the run has no weights."""
    shown = subject(subject_parser("report", "").parse_args([str(run_dir)]))
    arena = shown.config.arena
    results = shown.episodes(_EPISODES, _SEED)
    paths = [Path2D(r.robots, r.targets, r.obstacles, r.outcome) for r in results]
    trajectories(paths, arena, run_dir / "trajectories.png")
    write_film(run_dir / "evaluation.mp4", film_frames(arena, shortest(results)), FPS)


def shortest(results: Sequence[EpisodeResult]) -> list[EpisodeResult]:
    """The few shortest episodes, which are the ones to film."""
    return sorted(results, key=lambda r: r.frames)[:_FILMED]
