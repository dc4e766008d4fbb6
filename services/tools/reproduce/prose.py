"""What the report says in words, whatever the numbers are."""

from mrcdrl.services.tools.reproduce.printed import TABLE2
from mrcdrl.services.tools.reproduce.statistics import MIN_SEEDS, RESAMPLES


def _binomial(percent: float) -> str:
    """Variance of the successes of 100 independent episodes."""
    return f"{percent * (1 - percent / 100):.1f}"


_AVERAGES = {kind: _binomial(row.average) for kind, row in TABLE2.items()}
_VARIANCES = {kind: row.variance for kind, row in TABLE2.items()}

HOW_TO_READ = f"""A value is one training with its own seed; n counts the seeds of each side.
Estimates are interquartile means with 95 % bootstrap intervals. Verdicts:

- *reproduced*: better (p < 0.05 after Holm's correction), and the paper's difference lies within
  the interval;
- *direction only*: better, by another amount;
- *equal within ±3*: the whole interval lies within ±3 points;
- *contradicted*: significantly worse;
- *inconclusive*: the interval is too wide for any of these, or there are fewer than {MIN_SEEDS}
  seeds of each kind;
- *not tested*: these runs cannot tell.
"""

SCOPE = """The claims above, from the paper's abstract, Tables 1 and 2, Figs. 5 and 7 and section
5. The paper published no code, weights or data, and its authors were not asked.
"""

METHODOLOGY = f"""The paper's arena, images, rewards, network and test were written anew from its
text; docs/paper.md says what it leaves open and what was chosen. The protocol,
docs/reproduction.md, was written before the runs.

- All kinds have the same budget of learner steps, for each number of robots; no run is ended by
  its successes, and none is left out.
- Primary: the **final** weights from 1 100 starts that are the same for all, ε = 0.01, one
  collision is a failure. Secondary: the weights that did best in a run's own evaluations, from
  other starts.
- Intervals: percentile bootstrap, {RESAMPLES} resamples of the seeds. Tests: permutation of the
  seeds, Holm's correction over Duel – DDQN and DDQN – DQN. Probability of improvement after
  Agarwal et al. 2021.
"""

CELLS = """Ours: interquartile mean over seeds (95 % interval; number of seeds). The paper: one
run.
"""

OVERESTIMATION = """The paper infers overestimation from mean action values (Fig. 7 a–c). A high
value alone is not an overestimate: a better policy earns more. So the value of each first state
is compared with the discounted return that the same weights then earn, greedily and by training's
rules. In rewards; a success is worth 200 to each robot.
"""

SWEEP = """All kinds have one learning rate, the preset's. Would another favour one of them?
Success in the test with 2 robots. The protocol's rule: if another factor is better by more than 3
points for a kind, its runs are made anew with it.
"""

CANNOT_TELL = f"""- **Each of its cells is one run.** Two runs of one kind differ, too, by
  their seeds; one run of each kind cannot tell that from a difference between kinds.
- **Table 2's variances say nothing of robustness.** Successes of 100 independent episodes vary by
  100 p (1 − p): {_AVERAGES["dqn"]} at DQN's average,
  {_AVERAGES["ddqn"]} at DDQN's, {_AVERAGES["duel"]} at Duel's,
  where the paper has {_VARIANCES["dqn"]}, {_VARIANCES["ddqn"]} and
  {_VARIANCES["duel"]}. With 11 hundreds, such a variance is known to a factor of two.
- **86.14 and 92.33 are not averages of eleven whole hundreds**: eleven integers have an average
  that is a multiple of 1/11, and 86.14 and 92.33 are not. They come from another way of counting,
  which is not told.
- **Table 1 does not start at the first episode.** Early training has no successes; an average of
  83 with a variance of 21 leaves out how learning began. From which episode on is not told.
"""

EASY_DIFFICULT = """Easy: the arena's geometry, the rewards, the network, the test, and the
difference between the kinds are told well enough to write them down.

Difficult: what is not told decides how soon it learns: the optimizer and its rate, how often the
target network is updated, frames per training step, f_max, the size of the rectangle around a
robot, and whether targets stay in place. And one table of single runs had to be turned into
claims that can be tested.
"""
