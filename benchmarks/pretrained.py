"""Tests a run's best weights from 1 100 starts of the paper's test, and keeps them in pretrained/.

    python -m benchmarks.pretrained RUN [--name 4robots] [--set agent.symmetric_views=4]

The weights are tested as they are kept, in half precision; `mrcdrl demo` and `pretrained:NAME` then
find them. The starts are others than those by which the run chose its best weights.
"""

import argparse
import json
from dataclasses import asdict, replace
from pathlib import Path

from mrcdrl.common.config import load_config, to_toml
from mrcdrl.common.model.policy import averaged_symmetries
from mrcdrl.common.model.saved_policy import config_beside, policy_of, read_saved, weights_path
from mrcdrl.common.runtime.runs import find_weights
from mrcdrl.services.tools.evaluate import evaluate
from mrcdrl.services.tools.kept_weights import failures_text, keep, rounded, success_text
from mrcdrl.services.tools.progress import Progress
from mrcdrl.services.tools.subject import Subject

ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("run", help="a run, or a file of its weights")
    parser.add_argument("--name", help="of the folder; by default 4robots for 4 robots, and so on")
    parser.add_argument("--episodes", type=int, default=1100)
    parser.add_argument("--seed", type=int, default=0, help="of the starts")
    parser.add_argument("--note", default="", help="a sentence on how they were trained")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="of the configuration kept"
    )
    arguments = parser.parse_args()
    changed = dict(pair.split("=", 1) for pair in arguments.set)
    path = weights_path(find_weights(arguments.run))
    saved, config = read_saved(path), load_config(config_beside(path), changed, environ={})
    weights = replace(saved, payload=rounded(saved))
    policy = policy_of(path, weights, config).averaging(averaged_symmetries(config))
    tests = []
    for subject in Subject(config, policy, None, weights).each_number():
        with Progress() as progress:
            done = progress.stage("episodes", arguments.episodes)
            result, measures, _ = evaluate(subject, arguments.episodes, arguments.seed, done)
        tests.append({**asdict(result), "navigation": measures and asdict(measures)})
    numbers = config.arena.numbers
    name = arguments.name or f"{numbers[-1]}robots"
    manifest = {"run": path.parent.name, "success_rate": [t["success_rate"] for t in tests]}
    text = card(name, numbers, saved.learner_step, tests, arguments.note)
    keep(ROOT / "pretrained" / name, saved, to_toml(config), manifest, text)
    print(json.dumps({"name": name, "success_rates": manifest["success_rate"]}))


def card(name: str, numbers: tuple[int, ...], step: int, tests: list[dict], note: str) -> str:
    """What the weights are, how they were trained, how well they do, and how they fail."""
    tested = "\n\n".join(
        f"With {number} robot{'s' * (number > 1)}: {success_text(test)}\nKnown failures: "
        + failures_text(test)
        for number, test in zip(numbers, tests, strict=True)
    )
    return f"""# {name}

What: a network that chooses a robot's next action from that robot's last images alone. The file
holds its parameters in half precision, and was tested as it is.

How trained: {step} learner steps; `config.toml` has every setting. {note}

{tested}

Other numbers of robots and other places of targets were never seen in training, unless said above.

```sh
mrcdrl demo pretrained:{name}
mrcdrl evaluate pretrained:{name}
```
"""


if __name__ == "__main__":
    main()
