"""`mrcdrl render`: make a film of evaluation episodes, or a recording for rerun's viewer."""

from collections.abc import Sequence
from pathlib import Path

from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.errors import ConfigError
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
from mrcdrl.services.tools.subject import Subject, subject
from mrcdrl.services.tools.world_frames import world_frames

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
    if arena.is_custom and recorded:
        raise ConfigError(
            f"{arguments.out}: recordings show poses, which a custom world does not tell; write a "
            f"film, {' or '.join(SUFFIXES)}"
        )
    with Progress() as progress:
        if arena.is_custom:
            asked = (arguments.out, shown, arguments.episodes, arguments.seed)
            outcomes = write_world(*asked, progress)
        else:
            done = progress.stage("episodes", arguments.episodes)
            results = shown.episodes(arguments.episodes, arguments.seed, done)
            outcomes = [result.outcome for result in results]
            if recorded:
                progress.stage("recording")
                write_recording(arguments.out, arena, results)
            else:
                write_episodes(arguments.out, arena, results, progress)
    won = outcomes.count(Outcome.SUCCESS)
    print(f"{arguments.out}: {counted(len(outcomes), 'episode')}, {won} succeeded")
    return 0


def write_world(
    out: Path, shown: Subject, episodes: int, seed: int, progress: Progress
) -> list[Outcome]:
    """Film episodes of a custom world as they are played; their outcomes."""
    outcomes: list[Outcome] = []
    done = progress.stage(f"{out.name}, episodes", episodes)

    def ended(outcome: Outcome) -> None:
        outcomes.append(outcome)
        done(len(outcomes))

    write_film(out, world_frames(shown, episodes, seed, ended), FPS)
    return outcomes


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
