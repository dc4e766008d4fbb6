"""The docs say what the code does: every setting, key, message, metric and command is in them."""

import ast
import importlib
import importlib.util
import inspect
import re
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from types import ModuleType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
import pytest
import torch

import mrcdrl
from mrcdrl import cli
from mrcdrl.common.arena.controllers import CONTROLLERS
from mrcdrl.common.config import Config, TransportConfig, preset_names
from mrcdrl.common.messages.checks import RANGES
from mrcdrl.common.messages.metrics import SCHEMAS, kinds
from mrcdrl.common.messages.trajectory import (
    ArenaFrame,
    Chunk,
    EpisodeSummary,
    Evaluation,
    InsertReply,
    LeaseReply,
    LeaseRequest,
    Outcome,
    Priorities,
    PrioritiesReply,
    SampleRequest,
    Samples,
    Stats,
    Weights,
    WeightsNotice,
)
from mrcdrl.common.messages.wire import encode
from mrcdrl.common.model.q_network import QNetwork
from mrcdrl.common.model.weights_io import weights_to_bytes
from mrcdrl.common.runtime.files import MOVING_PICTURE, PICTURES
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.evaluator.navigation import Navigation, RobotNavigation
from mrcdrl.services.monitor.recorder import (
    EVALUATION_FIELDS,
    HISTOGRAMS,
    RATES,
    RESULTS,
    flat_metrics,
)
from mrcdrl.services.monitor.records import EpisodeRecord, EvaluationRecord
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.monitor.summary import summary
from mrcdrl.services.replay.inspect.contents import Contents
from mrcdrl.services.replay.inspect.export import arrays
from mrcdrl.services.replay.inspect.summary import summarize as summarize_log
from mrcdrl.services.tools.failure_summary import QUESTIONS, Share, as_json, summarize
from mrcdrl.services.tools.failures import Contact, Failure, LateRobot
from tests.patience import PATIENCE_S

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [*sorted(ROOT.glob("*.md")), *sorted(DOCS.rglob("*.md"))]
PROSE = "\n".join(path.read_text("utf-8") for path in PAGES)
README = (ROOT / "README.md").read_text("utf-8")
MESSAGES = (
    Chunk,
    InsertReply,
    SampleRequest,
    Samples,
    Priorities,
    PrioritiesReply,
    LeaseRequest,
    LeaseReply,
    Weights,
    WeightsNotice,
    EpisodeSummary,
    Evaluation,
    Stats,
    ArenaFrame,
)


def page(name: str) -> str:
    return (DOCS / name).read_text("utf-8")


def part(text: str, heading: str) -> str:
    """What stands below a heading, down to the next of its level or above."""
    level = heading.split(" ")[0]
    found = re.search(
        rf"^{re.escape(heading)}$(.*?)(?=^#{{1,{len(level)}}} |\Z)", text, re.M | re.S
    )
    assert found, f"no heading {heading!r}"
    return found[1]


def rows(text: str) -> list[list[str]]:
    """Cells of the tables' rows whose first cell is `a name`."""
    return [
        [cell.strip() for cell in line.strip("|").split(" | ")]
        for line in text.splitlines()
        if line.startswith("| `")
    ]


def names(text: str) -> list[str]:
    return [row[0].strip("` ") for row in rows(text)]


# -- configuration ----------------------------------------------------------------------


def generate() -> ModuleType:
    spec = importlib.util.spec_from_file_location("generate", DOCS / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_configuration_is_up_to_date() -> None:
    assert page("configuration.md") == generate().render(), "run: python docs/generate.py"


def test_commands_are_up_to_date() -> None:
    assert page("commands.md") == generate().render_commands(), "run: python docs/generate.py"


def test_tables_of_scaling_are_up_to_date() -> None:
    written = page("scaling.md")
    assert generate().render_scaling(written) == written, "run: python docs/generate.py"


def test_tables_of_metrics_are_up_to_date() -> None:
    for name in ("metrics", "monitoring"):
        written = page(f"{name}.md")
        rendered = getattr(generate(), f"render_{name}")(written)
        assert rendered == written, "run: python docs/generate.py"


def test_settings_named_in_the_docs_exist() -> None:
    known = {f"{s}.{f}" for s, info in Config.model_fields.items() for f in _fields(info)}
    sections = "|".join(Config.model_fields)
    for name in ("README.md", *(f"docs/{p.relative_to(DOCS)}" for p in DOCS.rglob("*.md"))):
        text = (ROOT / name).read_text("utf-8")
        for found in re.findall(rf"(?:`|--)((?:{sections})\.[a-z]\w*)(?=[` ]|$)", text):
            assert found in known or (ROOT / found).exists(), f"{name}: {found}"


def _fields(info: Any) -> list[str]:
    return list(info.annotation.model_fields)


def test_every_preset_is_described() -> None:
    assert set(preset_names()) == set(names(part(page("command-line.md"), "## Presets")))


# -- wire --------------------------------------------------------------------------------


@pytest.mark.parametrize("message", MESSAGES, ids=lambda m: m.__name__)
def test_message_is_documented(message: type) -> None:
    section = part(page("wire.md"), f"### {message.__name__}")
    hints = get_type_hints(message)
    expected = [(field.name, wire_type(hints[field.name])) for field in fields(message)]
    documented = [(row[0].strip("`"), row[1].strip("`")) for row in rows(section)]
    assert documented == expected


def test_schemas_are_documented() -> None:
    from mrcdrl.common.messages.wire import _SCHEMAS

    assert set(_SCHEMAS) == set(MESSAGES), "a message is missing in this test"
    for message, schema in _SCHEMAS.items():
        assert f"Schema `{schema}`" in part(page("wire.md"), f"### {message.__name__}")


def wire_type(hint: Any) -> str:
    """As docs/wire.md writes it."""
    if get_origin(hint) is np.ndarray:
        return np.dtype(get_args(get_args(hint)[1])[0]).name
    if get_origin(hint) is tuple:
        return f"[{', '.join(wire_type(a) for a in get_args(hint))}]"
    if get_origin(hint) is dict:
        return f"map of {wire_type(get_args(hint)[1])}"
    return "str" if hint is Outcome else str(hint.__name__)


def key_expressions() -> Iterator[str]:
    keys = Keys("RUN")
    values = {"shard": "SHARD", "worker": "WORKER", "actor": "WORKER", "role": "ROLE"}
    values |= {"name": "NAME", "incarnation": "NS"}
    for name, member in vars(Keys).items():
        if isinstance(member, property):
            yield getattr(keys, name)
        elif inspect.isfunction(member) and not name.startswith("_"):
            parameters = list(inspect.signature(member).parameters)[1:]
            yield member(keys, *(values[p] for p in parameters))


@pytest.mark.parametrize("key", sorted({k for k in key_expressions() if "*" not in k}))
def test_key_is_documented(key: str) -> None:
    shown = re.sub(r"\b(RUN|SHARD|WORKER|ROLE|NAME|NS)\b", lambda m: f"<{m[0].lower()}>", key)
    if shown.endswith("/*"):
        pytest.skip("a wildcard")
    assert shown in names(part(page("wire.md"), "## Keys"))


def number(value: float) -> str:
    """A limit as docs/wire.md writes it."""
    sign, size = "−" if value < 0 else "", abs(value)
    return sign + {2**30: "2^30", 2**53: "2^53", 2**63: "2^63"}.get(int(size), f"{size:g}")


def test_ranges_that_a_receiver_checks_are_documented() -> None:
    documented = {
        (row[0].strip("`"), field): row[2].removesuffix(" |")
        for row in rows(part(page("wire.md"), "## What a receiver checks"))
        for field in code(row[1])
    }
    checked = {
        (message.__name__, field): f"{number(low)} … {number(high)}"
        for message, ranges in RANGES.items()
        for field, (low, high) in ranges.items()
    }
    assert documented == checked


@pytest.mark.parametrize("precision", [torch.float32, torch.bfloat16, torch.float16], ids=str)
def test_example_subscriber_runs(precision: torch.dtype, tmp_path: Path) -> None:
    example = tmp_path / "watch.py"
    found = re.search(r"```python\n(.*?)```", page("wire.md"), re.S)
    assert found
    example.write_text(found[1], "utf-8")
    endpoint, keys = free_endpoint(), Keys("documented")
    weights = Weights.of(7, 3, 100, weights_to_bytes(QNetwork("dqn"), precision))
    test = Evaluation("e", 7, 3, 100, 2, 10, 0.5, 0.5, 0, (0.2, 0.8), 5, 5, 0, 9, 1, 0, 1)
    with Session(TransportConfig(listen=(endpoint,))) as session:
        process = subprocess.Popen(
            [sys.executable, str(example), endpoint, keys.run],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        lines: list[str] = []
        both = threading.Event()

        def read() -> None:
            assert process.stdout is not None
            for line in process.stdout:
                lines.append(line)
                if {line.split()[0] for line in lines} >= {"weights", "evaluation"}:
                    both.set()

        reader = threading.Thread(target=read)
        reader.start()
        try:
            weights_out = session.publisher(keys.weights)
            tests_out = session.publisher(keys.evaluation("e"))
            deadline = time.monotonic() + PATIENCE_S
            while not both.wait(0.1) and time.monotonic() < deadline:
                weights_out.put(encode(weights))  # until the example has subscribed
                tests_out.put(encode(test))
        finally:
            process.terminate()
            process.wait(PATIENCE_S)
            reader.join(PATIENCE_S)
            if process.stdout is not None:
                process.stdout.close()
    assert both.is_set(), "".join(lines)
    assert any(line.startswith("weights 3 ") and '"kind": "dqn"' in line for line in lines)
    assert "evaluation 3 0.5\n" in lines


# -- metrics -----------------------------------------------------------------------------


@pytest.mark.parametrize("role", SCHEMAS)
def test_metrics_are_documented(role: str) -> None:
    assert names(part(page("metrics.md"), f"## {role}")) == list(kinds(SCHEMAS[role]))


def test_run_files_are_documented() -> None:
    text, state, config = page("metrics.md"), RunState(Config()), Config()
    assert names(part(text, "## metrics.jsonl"))[:-1] == list(flat_metrics(state, 0.0))
    assert names(part(text, "## summary.json")) == list(summary(state, config, 0.0, "test"))
    for heading, record in (
        ("## episodes.jsonl", EpisodeRecord),
        ("## evaluations.jsonl", EvaluationRecord),
    ):
        assert names(part(text, heading)) == [field.name for field in fields(record)][:-1]


def test_tensorboard_tags_are_documented() -> None:
    tree = ast.parse((ROOT / "services/monitor/recorder.py").read_text("utf-8"))
    tags = {f"evaluation/{name}" for name in EVALUATION_FIELDS}
    tags |= {f"rates/{name}_per_s" for name in RATES} | {"learner/METRIC"}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "_event":
            tag = node.args[0]
            if isinstance(tag, ast.Constant):
                tags.add(str(tag.value))
            else:
                assert ast.unparse(tag)[2:].split("/")[0] in {"evaluation", "rates", "learner"}
    assert set(RESULTS) <= tags
    tags |= {f"learner/{name}" for name in HISTOGRAMS} | {"configuration"}
    tags |= {f"run/{Path(name).stem}" for name in (*PICTURES, MOVING_PICTURE)}
    assert set(names(part(page("metrics.md"), "## TensorBoard"))) == tags


# -- arena -------------------------------------------------------------------------------


def test_controllers_are_documented() -> None:
    assert names(part(page("arena.md"), "## Controllers")) == list(CONTROLLERS)


def test_measures_of_navigation_are_documented() -> None:
    measured = [field.name for of in (Navigation, RobotNavigation) for field in fields(of)]
    described = names(part(page("arena.md"), "## Measures of navigation"))
    assert [name for name in described if not name.startswith("field")] == measured


# -- failures ----------------------------------------------------------------------------


def test_what_is_said_of_failures_is_documented() -> None:
    text = part(page("failures.md"), "## JSON")
    said = as_json([], summarize([], 1), 0)
    assert names(text) == [*said, *QUESTIONS, *(field.name for field in fields(Failure))]
    for nested in (field.name for of in (Share, Contact, LateRobot) for field in fields(of)):
        assert f"`{nested}`" in text


# -- replay's log ------------------------------------------------------------------------


def test_what_inspect_says_is_documented() -> None:
    text = part(page("inspect.md"), "## JSON")
    said = summarize_log(Contents())
    assert names(text) == ["log", *said, *said["files"]]


def test_exported_arrays_are_documented() -> None:
    records = np.zeros((3, 4), np.uint8)
    octets, floats = np.ones(1, np.uint8), np.ones(1, np.float32)
    chunk = Chunk("a", 1, 0, 0, records, octets, floats, floats, octets, floats)
    exported = arrays(Contents(keys=[0], chunks=[chunk]))
    described = rows(part(page("inspect.md"), "## Arrays"))
    assert [row[0].strip("`") for row in described] == list(exported)
    for row in described:
        array = exported[row[0].strip("`")]
        dtype, shape = row[1].split(" ", 1)
        assert dtype == ("text" if array.dtype.kind == "U" else array.dtype.name)
        assert len([n for n in shape.strip("[]").split(", ") if n]) == array.ndim


# -- where is …, and the glossary ---------------------------------------------------------


def table(name: str) -> list[list[str]]:
    """Cells of all rows of a page's tables but their headings."""
    lines = [line for line in page(name).splitlines() if line.startswith("| ")]
    cells = [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in lines]
    return [row for row in cells if row[0] not in ("word", "where is …")]


def code(cell: str) -> list[str]:
    """All that stands in backquotes."""
    return re.findall(r"`([^`]+)`", cell)


def defined(path: Path) -> set[str]:
    """Names that a module defines, and as CLASS.NAME those that its classes do."""
    found: set[str] = set()
    tree = ast.parse(path.read_text("utf-8"))
    classes = [(f"{node.name}.", node.body) for node in tree.body if isinstance(node, ast.ClassDef)]
    for prefix, body in [("", tree.body), *classes]:
        for node in body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef):
                found.add(prefix + node.name)
            elif isinstance(node, ast.Assign | ast.AnnAssign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                found |= {prefix + ast.unparse(target) for target in targets}
    return found


@pytest.mark.parametrize("row", table("where-is.md"), ids=lambda row: row[0])
def test_it_is_where_the_page_says(row: list[str]) -> None:
    _, file, symbols = row
    path = ROOT / code(file)[0]
    assert code(symbols)
    for symbol in code(symbols):
        if path.suffix == ".py":
            assert symbol in defined(path)
        else:
            assert symbol in path.read_text("utf-8")


def test_the_glossary_is_in_order_and_its_files_exist() -> None:
    entries = table("glossary.md")
    words = [word.lower() for word, _, _ in entries]
    assert words == sorted(set(words))
    for word, _, file in entries:
        assert (ROOT / code(file)[0]).is_file(), word


def test_the_pages_to_start_from_are_linked() -> None:
    for name in ("architecture.md", "glossary.md", "where-is.md"):
        assert f"(docs/{name})" in README
        assert name == "architecture.md" or f"({name})" in page("architecture.md")


# -- the Python API ----------------------------------------------------------------------


def test_every_public_name_is_in_the_reference() -> None:
    directives = re.findall(r"^\.\. auto\w+:: mrcdrl\.(\w+)\b(?!\.)", page("api.md"), re.M)
    assert sorted(directives) == sorted(set(mrcdrl.__all__) - {"__version__"})


# -- commands ----------------------------------------------------------------------------


def test_every_command_is_described() -> None:
    section = part(page("command-line.md"), "## Commands")
    described = {name.removeprefix("mrcdrl ") for name in names(section)}
    assert described == set(cli.COMMANDS)


def command_lines() -> list[str]:
    """Lines of all pages that begin with mrcdrl, in blocks of shell."""
    blocks = re.findall(r"```sh\n(.*?)```", PROSE, re.S)
    return [line for block in blocks for line in block.splitlines() if line.startswith("mrcdrl ")]


@pytest.mark.parametrize("line", command_lines())
def test_command_and_its_flags_exist(line: str) -> None:
    name, _ = cli.split(line.split()[1:])
    assert name in cli.COMMANDS
    parser = cli.COMMANDS[name].parser()
    known = {word for action in parser._actions for word in action.option_strings}
    assert set(re.findall(r"--[a-z][\w.-]*", line)) <= known


def test_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text("utf-8")
    targets = set(re.findall(r"^([a-z]+):", makefile, re.M))
    named = set(re.findall(r"(?:^|`)make ([a-z]+)(?=`| +[#A-Z]|$)", PROSE, re.M))
    assert {"train", "test", "docs"} <= named <= targets


def test_the_citation_is_of_this_version() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text("utf-8")


@pytest.mark.parametrize("path", PAGES, ids=str)
def test_links_and_files_exist(path: Path) -> None:
    text = path.read_text("utf-8")
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        assert target.startswith("https://") or (path.parent / target).exists(), target
    for named in re.findall(
        r"`((?:common|services|configs|mrcdrl|tests|examples|docs)/[\w/.-]+)`", text
    ):
        assert (ROOT / named).exists(), named
