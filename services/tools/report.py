"""`mrcdrl report RUN`: write the plots of a run, as .png and .svg, and films."""

from collections.abc import Sequence
from pathlib import Path

from mrcdrl.common.runtime.files import FILM, MOVING_PICTURE
from mrcdrl.common.runtime.runs import find_run
from mrcdrl.services.plots.figures import training_curve, trajectories
from mrcdrl.services.plots.paper import SUFFIXES
from mrcdrl.services.tools import flags
from mrcdrl.services.tools.figure import paths_of
from mrcdrl.services.tools.progress import Progress
from mrcdrl.services.tools.render import write_episodes, write_world
from mrcdrl.services.tools.subject import subject

_EPISODES = 12
_FILMED = 4
_SEED = 0


def main(argv: Sequence[str]) -> int:
    """Write the plots and the film; return the exit code."""
    arguments = flags.report().parse_args(argv)
    run_dir = find_run(arguments.run, arguments.run_dir)
    files = plots(run_dir, "training")
    with Progress() as progress:
        progress.stage("training.png")
        training_curve(run_dir, *files)
        print(*files, sep="\n")
        draw_episodes(run_dir, progress)
    return 0


def draw_episodes(run_dir: Path, progress: Progress) -> None:
    """Plot and film episodes of the best weights; CheckpointError if the run has no weights.

    A custom world has no poses to draw; it is filmed.
    """
    shown = subject(flags.evaluate().parse_args([str(run_dir)]))
    arena = shown.config.arena
    if arena.is_custom:
        write_world(run_dir / FILM, shown, _FILMED, _SEED, progress)
        print(run_dir / FILM)
        return
    results = shown.episodes(_EPISODES, _SEED, progress.stage("episodes", _EPISODES))
    files = plots(run_dir, "trajectories")
    progress.stage("trajectories.png")
    trajectories(paths_of(results), arena, *files)
    # Films come last: whoever ends this command before its end then knows which file is cut off.
    moving, film = run_dir / MOVING_PICTURE, run_dir / FILM
    write_episodes(moving, arena, results[:1], progress, f"the first of {_EPISODES} episodes")
    note = f"the first {_FILMED} of {_EPISODES} episodes"
    write_episodes(film, arena, results[:_FILMED], progress, note)
    print(*files, moving, film, sep="\n")


def plots(run_dir: Path, name: str) -> list[Path]:
    """The files of a plot, one in each format."""
    return [run_dir / f"{name}{suffix}" for suffix in SUFFIXES]
