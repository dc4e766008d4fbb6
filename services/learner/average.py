"""An exponential average of a network's parameters, for acting and evaluation.

Late in training the noise of single steps moves the policy more than learning does; the average of
recent parameters acts better (BBF, Schwarzer et al. 2023; Averaged-DQN, Anschel et al. 2017).
"""

import copy

import torch
from torch import Tensor

from mrcdrl.common.model.q_network import QNetwork


class ParameterAverage:
    """Keeps `decay` of the average with each learner step, and less during the first ones.

    After n steps it keeps at most (1 + n) / (10 + n), so that it soon forgets the initial
    parameters.
    """

    def __init__(self, online: QNetwork, decay: float) -> None:
        """decay: 0 ... 1, 1 excluded."""
        self.network = copy.deepcopy(online).requires_grad_(requires_grad=False)
        self._decay = decay

    def reset(self, online: QNetwork) -> None:
        """Begin anew with these parameters."""
        self.network.load_state_dict(online.state_dict())

    def update(self, online: QNetwork, learner_step: int, num_steps: int) -> None:
        """Take in the parameters that `num_steps` steps led to; learner_step: the number of all."""
        keep = min(self._decay, (1 + learner_step) / (10 + learner_step)) ** num_steps
        averages: list[Tensor] = list(self.network.parameters())
        parameters: list[Tensor] = list(online.parameters())
        with torch.no_grad():
            torch._foreach_lerp_(averages, parameters, 1.0 - keep)
