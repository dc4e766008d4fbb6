"""The weights that are kept: of each kind and number of robots the final ones of the median seed.

    OUT/weights/duel-4robots/
        model.safetensors   in half precision
        model.json          its digest, and the run that it is of
        config.toml         the run's configuration
        README.md           what it is, how it was trained, how well it does, how it fails

A folder is one that `mrcdrl evaluate`, `render`, `figure` and `export` take, runs or no runs.
Invariants: a folder holds the weights that its card describes, or is missing.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mrcdrl.common.config import to_toml
from mrcdrl.common.errors import CheckpointError
from mrcdrl.common.model.saved_policy import read_saved, weights_path
from mrcdrl.common.model.weights_files import read_weights, write_weights
from mrcdrl.common.model.weights_io import SENT_AS, network_from_bytes, weights_to_bytes
from mrcdrl.common.runtime.files import RUN_CONFIG, WEIGHTS_SUFFIX, atomic_write
from mrcdrl.services.tools.experiment.cell import CellFiles
from mrcdrl.services.tools.experiment.grid import FINAL
from mrcdrl.services.tools.reproduce.printed import NAMES
from mrcdrl.services.tools.reproduce.runs import Result, Runs

FOLDER = "weights"
_MODEL = f"model{WEIGHTS_SUFFIX}"
_CARD = "README.md"
_PRECISION = "float16"


def kept(out: Path, kind: str, robots: int) -> Path:
    """The folder of the weights kept, which may be missing."""
    return out / FOLDER / f"{kind}-{robots}robots"


def is_kept(folder: Path, result: Result) -> bool:
    """Whether the folder holds the weights of this run."""
    try:
        _, manifest = read_weights(folder / _MODEL)
    except CheckpointError:
        return False
    return manifest.get("cell") == result["cell"] and (folder / _CARD).exists()


def keep_weights(runs: Runs, out: Path) -> Iterator[str]:
    """Keep the weights of all median seeds that are not kept yet; yield what cannot be kept."""
    for kind, robots in runs.plan.kinds:
        result = runs.median(kind, robots)
        folder = kept(out, kind, robots)
        if result is None or is_kept(folder, result):
            continue
        (cell,) = [c for c in runs.plan.kinds[kind, robots] if c.name == result["cell"]]
        source = CellFiles(cell, out).weights(FINAL)
        if source is None:
            yield f"weights of {cell.name}: the run's folder is gone"
            continue
        _keep(folder, source, result, to_toml(cell.config))


def _keep(folder: Path, source: Path, result: Result, config: str) -> None:
    weights = read_saved(weights_path(source))
    rounded = weights_to_bytes(network_from_bytes(weights.payload), SENT_AS[_PRECISION])
    folder.mkdir(parents=True, exist_ok=True)
    atomic_write(folder / RUN_CONFIG, config.encode())
    manifest: dict[str, Any] = {
        "cell": result["cell"],
        "weights_epoch": weights.epoch,
        "weights_version": weights.version,
        "learner_step": weights.learner_step,
        "precision": _PRECISION,
        "success_rate": result["evaluate"][FINAL]["success_rate"],
    }
    write_weights(folder / _MODEL, rounded, manifest)
    atomic_write(folder / _CARD, card(result, folder.name).encode())


def card(result: Mapping[str, Any], name: str) -> str:
    """What the weights are, how they were trained, how well they do, and how they fail."""
    test = result["evaluate"][FINAL]
    low, high = test["success_interval"]
    navigation = test["navigation"]
    kind = name.partition("-")[0]
    met, wall = (navigation[f"collision_with_{whom}_rate"] for whom in ("robot", "wall"))
    return f"""# {NAMES[kind]}, {result["robots"]} robots

What: the network of the paper's {NAMES[kind]}. It chooses a robot's next action from that robot's
last images. The file holds its parameters in half precision ({_PRECISION}).

How trained: {result["learner_steps"]} learner steps, seed {result["seed"]}. Of all seeds of this
kind it has the median success. These are the run's last weights, not its best. `{RUN_CONFIG}` has
every setting; the run is `{result["cell"]}`.

Success: {100 * test["success_rate"]:.1f} % of {test["episodes"]} starts of the paper's test (95 %
interval {100 * low:.1f} to {100 * high:.1f}), ε 0.01, one collision fails. It was measured before
the parameters were rounded to half precision.

Known failures: of all starts {100 * met:.1f} % end by a robot that hits a robot, {100 * wall:.1f} %
by one that hits a wall, {100 * test["timeout_rate"]:.1f} % by running out of time. Other numbers of
robots and other places of targets were never seen in training.

In this folder:

```sh
mrcdrl evaluate {_MODEL} --failures 5
mrcdrl render {_MODEL} --out film.mp4
```
"""
