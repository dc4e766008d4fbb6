"""A configured table's capacity and memory."""

import pytest

from mrcdrl.common.config import Config, load_config
from mrcdrl.common.errors import ConfigError
from mrcdrl.services.replay.capacity import table_bytes
from mrcdrl.services.replay.limiter import RateLimiter
from mrcdrl.services.replay.table import Table


def config_of(**replay: object) -> Config:
    given = {f"replay.{name}": str(value) for name, value in replay.items()}
    return load_config("smoke", {"replay.capacity": "5000", **given}, environ={})


def test_shards_split_capacity_and_min_size() -> None:
    assert Table.from_config(config_of(shards=3)).capacity == 1667
    limiter = RateLimiter.from_config(config_of(shards=3))
    assert limiter.min_size == -(-config_of().replay.min_size // 3)


@pytest.mark.parametrize("sampler", ["uniform", "prioritized"])
@pytest.mark.parametrize("shards", [1, 2])
def test_the_memory_of_all_shards_stays_below_its_limit(sampler: str, shards: int) -> None:
    limit = 300_000
    config = config_of(capacity_bytes=limit, sampler=sampler, shards=shards)
    table = Table.from_config(config)
    assert table.capacity < 5000 // shards
    assert 0.7 * limit < shards * table.nbytes <= 1.01 * limit  # a few rows more, for the wrap
    assert table_bytes(config) == pytest.approx(table.nbytes, rel=0.3)


def test_memory_that_suffices_changes_nothing() -> None:
    assert Table.from_config(config_of(capacity_bytes=1 << 30)).capacity == 5000


def test_memory_for_less_than_min_size_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"holds \d+ transitions of \d+ bytes, fewer than"):
        Table.from_config(config_of(capacity_bytes=1000))
