"""Distributed actor-learner for multi-robot coordination from images, over Eclipse Zenoh.

    import mrcdrl

    config = mrcdrl.load_config("quick", {"arena.num_robots": "4"})
    env = mrcdrl.ArenaParallelEnv(config.arena)  # pip install 'mrcdrl[env]'
    policy = mrcdrl.load_policy("runs/four")  # pip install 'mrcdrl[learn]'

| names | what they are |
|---|---|
| `load_config`, `Config`, `ArenaConfig` | the configuration, from a preset or a file |
| `load_policy`, `LivePolicy` | a policy with saved weights, or with a running run's newest |
| `Arena` | the simulator of one arena |
| `ArenaParallelEnv` | the arena for PettingZoo |
| `ArenaVectorEnv`, `ArenaVecEnv` | the same for Gymnasium and for stable-baselines3 |
| `CONTROLLERS`, `make_controller` | controllers that see the true state |
| `MrcdrlError`, `ConfigError` | the base of all errors, and the error of a wrong setting |

Each name is imported on first use, so `import mrcdrl` alone loads neither PyTorch nor numpy. A name
whose extra is not installed raises ImportError.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mrcdrl.common.arena import Arena
    from mrcdrl.common.arena.controllers import CONTROLLERS, make_controller
    from mrcdrl.common.arena.envs.parallel_env import ArenaParallelEnv
    from mrcdrl.common.arena.envs.sb3 import ArenaVecEnv
    from mrcdrl.common.arena.envs.vector_env import ArenaVectorEnv
    from mrcdrl.common.config import ArenaConfig, Config, load_config
    from mrcdrl.common.errors import ConfigError, MrcdrlError
    from mrcdrl.common.model.saved_policy import load_policy
    from mrcdrl.common.sync.live_policy import LivePolicy

    __version__: str

__all__ = [
    "CONTROLLERS",
    "Arena",
    "ArenaConfig",
    "ArenaParallelEnv",
    "ArenaVecEnv",
    "ArenaVectorEnv",
    "Config",
    "ConfigError",
    "LivePolicy",
    "MrcdrlError",
    "__version__",
    "load_config",
    "load_policy",
    "make_controller",
]

_MODULES = {
    "Arena": "common.arena",
    "ArenaConfig": "common.config",
    "ArenaParallelEnv": "common.arena.envs.parallel_env",
    "ArenaVecEnv": "common.arena.envs.sb3",
    "ArenaVectorEnv": "common.arena.envs.vector_env",
    "CONTROLLERS": "common.arena.controllers",
    "Config": "common.config",
    "ConfigError": "common.errors",
    "LivePolicy": "common.sync.live_policy",
    "MrcdrlError": "common.errors",
    "load_config": "common.config",
    "load_policy": "common.model.saved_policy",
    "make_controller": "common.arena.controllers",
}


def __getattr__(name: str) -> object:
    """Import a public name on first use, and keep it."""
    if name == "__version__":
        from importlib.metadata import version

        return globals().setdefault(name, version("mrcdrl"))
    from mrcdrl.common.runtime.lazy import imported

    return imported(__name__, _MODULES, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
