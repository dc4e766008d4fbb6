"""What the system tests share: one small finished run."""

import pytest

from tests.system.system_processes import (
    SMALL,
    Command,
    Finished,
    end_all,
    processes_of,
    run_name,
    shared_memory_files,
)


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """`mrcdrl train --config smoke`, no terminal."""
    folder = tmp_path_factory.mktemp("finished")
    name, before = run_name("smoke"), shared_memory_files()
    arguments = ["train", "--config", "smoke", "--run-dir", folder, "--name", name, *SMALL]
    with Command([*arguments, "--learner-steps", "60"], folder) as train:
        code = train.wait(600)
    left = processes_of(name)
    end_all(name)
    return Finished(
        name, folder / name, code, train.out, train.err, left, shared_memory_files() - before
    )
