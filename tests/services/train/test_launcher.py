"""A run that no service could serve is refused before anything is written."""

from pathlib import Path

import pytest

from mrcdrl.common.config import load_config
from mrcdrl.common.errors import ConfigError
from mrcdrl.services.train.launcher import check_possible


def test_initial_weights_that_do_not_exist_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    config = load_config("smoke", {"learner.initial_weights": str(path)}, environ={})
    with pytest.raises(ConfigError, match=r"learner\.initial_weights .*weights\.safetensors: no"):
        check_possible(config)
    path.touch()
    check_possible(config)
