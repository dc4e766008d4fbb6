"""Every Zenoh key expression of a run; no other module spells one out.

mrcdrl/<run>/replay/<shard>/insert     query: Chunk -> InsertReply
mrcdrl/<run>/replay/<shard>/sample     query: SampleRequest -> Samples
mrcdrl/<run>/replay/<shard>/priorities query: Priorities -> PrioritiesReply
mrcdrl/<run>/config                    query: nothing -> the configuration as TOML
mrcdrl/<run>/leases                    query: LeaseRequest -> LeaseReply
mrcdrl/<run>/weights                   publication and query: Weights
mrcdrl/<run>/weights/notice            publication and query: WeightsNotice
mrcdrl/<run>/weights/average           query: nothing -> Weights
mrcdrl/<run>/evaluation/<worker>       publication: Evaluation
mrcdrl/<run>/episodes/<actor>          publication: EpisodeSummary
mrcdrl/<run>/stats/<role>/<worker>     publication: Stats
mrcdrl/<run>/arena/<role>/<worker>     publication: ArenaFrame
mrcdrl/<run>/live/<role>/<worker>      liveliness token
mrcdrl/<run>/claim/<role>/<name>/<ns>  liveliness token
"""

from dataclasses import dataclass

from mrcdrl.common.runtime.names import MAX_NAME, check_name, printable


@dataclass(frozen=True, slots=True)
class Keys:
    """The key expressions of one run."""

    run: str

    def __post_init__(self) -> None:
        check_name(self.run, "run name")

    def insert(self, shard: int = 0) -> str:
        return f"mrcdrl/{self.run}/replay/{shard}/insert"

    def sample(self, shard: int = 0) -> str:
        return f"mrcdrl/{self.run}/replay/{shard}/sample"

    def priorities(self, shard: int = 0) -> str:
        return f"mrcdrl/{self.run}/replay/{shard}/priorities"

    @property
    def config(self) -> str:
        return f"mrcdrl/{self.run}/config"

    @property
    def leases(self) -> str:
        return f"mrcdrl/{self.run}/leases"

    @property
    def weights(self) -> str:
        return f"mrcdrl/{self.run}/weights"

    @property
    def weights_notice(self) -> str:
        return f"mrcdrl/{self.run}/weights/notice"

    @property
    def weights_average(self) -> str:
        return f"mrcdrl/{self.run}/weights/average"

    def evaluation(self, worker: str) -> str:
        return f"mrcdrl/{self.run}/evaluation/{worker}"

    def episodes(self, actor: str) -> str:
        return f"mrcdrl/{self.run}/episodes/{actor}"

    def stats(self, role: str, worker: str) -> str:
        return f"mrcdrl/{self.run}/stats/{role}/{worker}"

    def arena(self, role: str, worker: str) -> str:
        return f"mrcdrl/{self.run}/arena/{role}/{worker}"

    def live(self, role: str, worker: str) -> str:
        return f"mrcdrl/{self.run}/live/{role}/{worker}"

    def claim(self, role: str, name: str, incarnation: str) -> str:
        return f"mrcdrl/{self.run}/claim/{role}/{name}/{incarnation}"

    @property
    def every_evaluation(self) -> str:
        return self.evaluation("*")

    @property
    def every_episode(self) -> str:
        return self.episodes("*")

    @property
    def every_stats(self) -> str:
        return self.stats("*", "*")

    def everyone(self, role: str = "*") -> str:
        return self.live(role, "*")


def role_and_worker(live_key: str) -> tuple[str, str]:
    """The role and worker in a liveliness token's key, fit to be shown."""
    role, worker = live_key.split("/")[-2:]
    return printable(role)[:MAX_NAME], printable(worker)[:MAX_NAME]
