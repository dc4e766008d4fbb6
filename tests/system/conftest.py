"""A small finished run, shared by the system tests."""

from pathlib import Path

import pytest
from filelock import FileLock
from pydantic import TypeAdapter

from tests.patience import eventually
from tests.system.system_processes import (
    Command,
    Finished,
    end_all,
    processes_of,
    run_name,
    shared_memory_of,
    smoke_training,
)

_FINISHED = TypeAdapter(Finished)


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Finished:
    """A run of `mrcdrl train --config smoke` without a terminal, one for all workers of pytest."""
    shared = tmp_path_factory.getbasetemp()
    if hasattr(request.config, "workerinput"):  # pytest-xdist's: each worker has a folder in it
        shared = shared.parent
    kept = shared / "finished.json"
    with FileLock(shared / "finished.lock"):
        if not kept.exists():
            folder = shared / "finished"
            folder.mkdir()
            kept.write_bytes(_FINISHED.dump_json(_train(folder)))
    return _FINISHED.validate_json(kept.read_bytes())


def _train(folder: Path) -> Finished:
    name, mapped = run_name("smoke"), set[Path]()

    def ended() -> bool:
        mapped.update(shared_memory_of(name))
        return train.process.poll() is not None

    arguments = smoke_training(folder, name)
    with Command([*arguments, "--learner-steps", "60"], folder) as train:
        eventually(ended, "the run ends by itself", 600, pause_s=1.0)
        code = train.wait()
    left = processes_of(name)
    end_all(name)
    return Finished(name, folder / name, code, train.out, train.err, left, mapped)
