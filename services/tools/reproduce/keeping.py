"""The weights that are kept: of each kind and number of robots the final ones of the median seed.

They lie in OUT/weights/KIND-Nrobots, folders of `mrcdrl.services.tools.kept_weights`.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mrcdrl.common.config import to_toml
from mrcdrl.common.model.saved_policy import read_saved, weights_path
from mrcdrl.common.runtime.files import RUN_CONFIG
from mrcdrl.services.tools.experiment.cell import CellFiles
from mrcdrl.services.tools.experiment.grid import FINAL
from mrcdrl.services.tools.kept_weights import (
    MODEL,
    PRECISION,
    failures_text,
    keep,
    manifest_of,
    success_text,
)
from mrcdrl.services.tools.reproduce.printed import NAMES
from mrcdrl.services.tools.reproduce.runs import Result, Runs

FOLDER = "weights"


def kept(out: Path, kind: str, robots: int) -> Path:
    """The folder of the weights kept, which may be missing."""
    return out / FOLDER / f"{kind}-{robots}robots"


def is_kept(folder: Path, result: Result) -> bool:
    """Whether the folder holds the weights of this run."""
    manifest = manifest_of(folder)
    return manifest is not None and manifest.get("cell") == result["cell"]


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
        manifest = {
            "cell": result["cell"],
            "success_rate": result["evaluate"][FINAL]["success_rate"],
        }
        weights, config = read_saved(weights_path(source)), to_toml(cell.config)
        keep(folder, weights, config, manifest, card(result, folder.name))


def card(result: Mapping[str, Any], name: str) -> str:
    """What the weights are, how they were trained, how well they do, and how they fail."""
    test = result["evaluate"][FINAL]
    kind = name.partition("-")[0]
    return f"""# {NAMES[kind]}, {result["robots"]} robots

What: the network of the paper's {NAMES[kind]}. It chooses a robot's next action from that robot's
last images. The file holds its parameters in half precision ({PRECISION}).

How trained: {result["learner_steps"]} learner steps, seed {result["seed"]}. Of all seeds of this
kind it has the median success. These are the run's last weights, not its best. `{RUN_CONFIG}` has
every setting; the run is `{result["cell"]}`.

Success: {success_text(test)} It was measured before
the parameters were rounded to half precision.

Known failures: {failures_text(test)} Other numbers of
robots and other places of targets were never seen in training.

In this folder:

```sh
mrcdrl evaluate {MODEL} --failures 5
mrcdrl render {MODEL} --out film.mp4
```
"""
