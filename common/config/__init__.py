"""The configuration of a run: its schema, its sources, and its TOML form."""

from mrcdrl.common.config.differences import differences, nearest_preset
from mrcdrl.common.config.kept import refuse_changes
from mrcdrl.common.config.load import (
    DEFAULT_PRESET,
    apply_overrides,
    load_config,
    load_transport,
    preset_names,
    resolved_environment,
    validate_config,
    variable,
)
from mrcdrl.common.config.schema import (
    AgentConfig,
    ArenaConfig,
    Config,
    CurriculumConfig,
    ExplorationConfig,
    LearnerConfig,
    ReplayConfig,
    RunConfig,
    TransportConfig,
    kept_settings,
    sections,
)
from mrcdrl.common.config.toml import from_toml, to_toml

__all__ = [
    "DEFAULT_PRESET",
    "AgentConfig",
    "ArenaConfig",
    "Config",
    "CurriculumConfig",
    "ExplorationConfig",
    "LearnerConfig",
    "ReplayConfig",
    "RunConfig",
    "TransportConfig",
    "apply_overrides",
    "differences",
    "from_toml",
    "kept_settings",
    "load_config",
    "load_transport",
    "nearest_preset",
    "preset_names",
    "refuse_changes",
    "resolved_environment",
    "sections",
    "to_toml",
    "validate_config",
    "variable",
]
