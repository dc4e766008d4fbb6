"""Statistics as Prometheus takes them: the name, unit and help of each metric, and its samples.

Invariants: a counter never falls, except to 0 with its process. Label values are printable and
bounded, and no two samples of a family have the same ones.
"""

from collections.abc import Callable, Iterable, Iterator

from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from mrcdrl.common.messages.metrics import SCHEMAS, Definition, definitions
from mrcdrl.common.runtime.names import MAX_NAME, printable
from mrcdrl.common.runtime.versions import versions
from mrcdrl.common.sync.stats import Report

_COUNTERS = ("counter", "pace")
# as help texts say them; others as they are
_UNITS = {"s": "seconds", "bytes": "", "0 or 1": "1 if", "0 … 1": ""}
_SUFFIXES = {"share": ("_share", "_ratio"), "0 … 1": ("", "_ratio"), "s": ("_s", "_seconds")}


class ServiceFamilies:
    """Makes metric families of services' reports, and keeps their counters from falling."""

    def __init__(self) -> None:
        self._rising: dict[tuple[str, ...], tuple[float, float]] = {}  # last value, and the sum

    def families(self, reports: Iterable[Report]) -> Iterator[Metric]:
        """A family for each metric that any of them reports; of equal names the first counts.

        Counters that are kept with the run, and may fall back with a checkpoint, are counted from
        the first report on.
        """
        known: dict[tuple[str, str, str], Report] = {}
        for report in reports:
            labels = (label_value(report.run), label_value(report.worker))
            known.setdefault((report.role, *labels), report)
        rising: dict[tuple[str, ...], tuple[float, float]] = {}
        for role, schema in SCHEMAS.items():
            found: dict[str, Metric] = {}
            for each in definitions(schema):
                for key, report in known.items():
                    if key[0] != role or each.name not in report.metrics:
                        continue
                    value = report.metrics[each.name]
                    if each.meaning.kind == "pace" and role != "actor":
                        last, total = self._rising.get((*key, each.name), (value, 0.0))
                        total += max(0.0, value - last)
                        rising[(*key, each.name)] = value, total
                        value = total
                    family = found.setdefault(each.field, _family(role, each))
                    _add(family, [*key[1:], each.item] if each.item else list(key[1:]), value)
            yield from found.values()
        self._rising = rising


class ProcessMetrics(Collector):
    """One process's own statistics: what it last reported, and what it is made of.

    report: None for a process that reports nothing.
    """

    def __init__(self, report: Callable[[], Report] | None) -> None:
        self._report = report
        self._families = ServiceFamilies()
        self._versions = {name: label_value(text) for name, text in versions().items()}

    def collect(self) -> Iterator[Metric]:
        """The families of this moment."""
        yield InfoMetricFamily("mrcdrl_build", "Versions in this process.", value=self._versions)
        if self._report is not None:
            yield from self._families.families([self._report()])


def process_registry(report: Callable[[], Report] | None) -> CollectorRegistry:
    """A registry of one process: its statistics, processor time, memory and open files."""
    registry = CollectorRegistry()
    registry.register(ProcessMetrics(report))
    ProcessCollector(registry=registry)
    return registry


def exposed_name(role: str, each: Definition) -> str:
    """The metric's name for Prometheus."""
    name = each.meaning.exposed or each.field.removeprefix(f"{role}_")
    ours, theirs = _SUFFIXES.get(each.meaning.unit, ("", ""))
    total = "_total" if each.meaning.kind in _COUNTERS else ""
    return f"mrcdrl_{role}_{name.removesuffix(ours)}{theirs}{total}"


def help_text(role: str, each: Definition) -> str:
    """What the metric means, in plain text."""
    unit = _UNITS.get(each.meaning.unit, each.meaning.unit)
    if each.meaning.kind == "share" and unit == "share":
        unit = "share of time"
    words = " ".join(filter(None, (unit, each.meaning.text.replace("`", ""))))
    return f"{each.field} of {role}: {words}."


def label_value(text: str) -> str:
    """What a peer says, fit for a label: printable and no longer than a name."""
    return printable(text[:MAX_NAME])


def _family(role: str, each: Definition) -> Metric:
    labels = ["run", "worker", *filter(None, [each.meaning.label])]
    counts = each.meaning.kind in _COUNTERS
    made = CounterMetricFamily if counts else GaugeMetricFamily
    return made(exposed_name(role, each), help_text(role, each), labels=labels)


def _add(family: Metric, labels: list[str], value: float) -> None:
    if isinstance(family, CounterMetricFamily | GaugeMetricFamily):
        family.add_metric(labels, value)
