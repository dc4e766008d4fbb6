"""`mrcdrl render`: make a film of evaluation episodes, or a recording for rerun's viewer."""

from collections.abc import Sequence
from pathlib import Path

from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import Outcome
from mrcdrl.common.runtime.files import prepare_output
from mrcdrl.services.evaluator.trial import EpisodeResult
from mrcdrl.services.monitor.phase import counted
from mrcdrl.services.plots.figures import check_suffix
from mrcdrl.services.plots.film import SUFFIXES, write_film
from mrcdrl.services.tools import flags
from mrcdrl.services.tools.episode_frames import film_frames, num_film_frames
from mrcdrl.services.tools.progress import Progress
from mrcdrl.services.tools.rerun_recording import SUFFIX, check_rerun, write_recording
from mrcdrl.services.tools.subject import subject

FPS = 30


def main(argv: Sequence[str]) -> int:
    """Write the film or recording; return the exit code."""
    arguments = flags.render().parse_args(argv)
    check_suffix(arguments.out, (*SUFFIXES, SUFFIX))
    prepare_output(arguments.out)
    recorded = arguments.out.suffix == SUFFIX
    if recorded:
        check_rerun()
    shown = subject(arguments)
    arena = shown.config.arena
    with Progress() as progress:
        done = progress.stage("episodes", arguments.episodes)
        results = shown.episodes(arguments.episodes, arguments.seed, done)
        if recorded:
            progress.stage("recording")
            write_recording(arguments.out, arena, results)
        else:
            write_episodes(arguments.out, arena, results, progress)
    won = sum(result.outcome is Outcome.SUCCESS for result in results)
    print(f"{arguments.out}: {counted(len(results), 'episode')}, {won} succeeded")
    return 0


def write_episodes(
    out: Path,
    arena: ArenaConfig,
    results: Sequence[EpisodeResult],
    progress: Progress,
    note: str = "",
) -> None:
    """Film episodes whose paths were kept; raises MrcdrlError as `write_film` does.

    note: which episodes these are.
    """
    images = film_frames(arena, results, note)
    frames = progress.over(images, f"{out.name}, frames", num_film_frames(results))
    write_film(out, frames, FPS)
