// The charts of a run: what each shows, in a sentence, and where docs/metrics.md says more.
export const FIGURES = [
  {
    title: "Success", unit: " %", link: "evaluationsjsonl", range: (_, low, high) => [0, Math.max(100, high ?? 100)],
    text: "Episodes in which all robots reach a target without a collision. Training episodes include random actions; in the test few are random, and the band says how sure it is (95 %).",
    series: [
      { label: "training, last 100", column: "training", colour: 0 },
      { label: "test", column: "test", colour: 2, points: true },
      { label: "at most", column: "high", quiet: true, band: { colour: 2 } },
      { label: "at least", column: "low", quiet: true },
    ],
  },
  {
    title: "Score of an episode", link: "episodesjsonl",
    text: "The rewards of a training episode, added up: reaching targets adds, collisions and time take away. It should rise.",
    series: [{ label: "score", column: "score" }],
  },
  {
    title: "Loss", link: "learner", log: true,
    text: "How far the network's predictions are from their targets. It need not fall: as robots get farther, there is more to predict.",
    series: [{ label: "loss", column: "loss" }, { label: "gradient norm", column: "gradient_norm", colour: 3 }],
  },
  {
    title: "TD errors", link: "learner", log: true,
    text: "The errors of single predictions: half, nine tenths and 99 of 100 are below these lines. Outliers show in the highest.",
    series: [{ label: "half", column: "td_error_p50" }, { label: "90 %", column: "td_error_p90", colour: 3 }, { label: "99 %", column: "td_error_p99", colour: 1 }],
  },
  {
    title: "Action values (Q)", link: "learner",
    text: "What the network expects of its actions. They rise as robots succeed, and should never run away.",
    series: [{ label: "greatest", column: "q_max", colour: 1 }, { label: "of the best actions, mean", column: "mean_q", colour: 2 }, { label: "median", column: "q_p50" }, { label: "smallest", column: "q_min", colour: 4 }],
  },
  {
    title: "Exploration (ε)", link: "actor", range: (_, low, high) => [0, Math.max(0.1, high ?? 1)],
    text: "Share of random actions in training. It falls, so that robots try things first and use what they have learned later.",
    series: [{ label: "greatest", column: "epsilon_max" }, { label: "smallest", column: "epsilon_min", colour: 4 }],
  },
  {
    title: "Pace", unit: "/s", link: "metricsjsonl", log: true,
    text: "What the run does in a second: robots' steps made, transitions taken from replay, learning steps.",
    series: [{ label: "robot steps", column: "robot_steps_per_s", colour: 5 }, { label: "samples", column: "samples_per_s", colour: 3 }, { label: "learner steps", column: "learner_steps_per_s", colour: 4 }],
  },
  {
    title: "Replay", unit: " %", link: "replay", range: () => [0, 100],
    text: "How full the memory of past steps is. Once it is full, the oldest steps are forgotten.",
    series: [{ label: "filled", column: "fill" }],
  },
  {
    title: "Samples per insert", link: "replay",
    text: "How often each step is learned from, on average. Replay holds it at the configured ratio.",
    series: [{ label: "samples per insert", column: "samples_per_insert" }],
  },
  {
    title: "Age of the actors' weights", link: "metricsjsonl",
    text: "How old the stalest actor's weights are. Robots that act by old weights show what is no longer true.",
    series: [{ label: "seconds", column: "staleness_s" }, { label: "versions behind", column: "staleness_versions", colour: 3 }],
  },
];

// Columns that charts need, from what the server sends; axis as of `withAxis`.
export function derived(history, episodes, tests, { withAxis, joined }, axis) {
  const own = withAxis(history, axis);
  own.training = own.successes_per_100;
  own.fill = (own.replay_size ?? []).map((size, i) => (own.replay_capacity[i] ? (100 * size) / own.replay_capacity[i] : null));
  const scores = withAxis(episodes, axis);
  const ordered = [...tests].sort((a, b) => (axis === "time" ? a.time_s - b.time_s : a.learner_step - b.learner_step));
  const each = withAxis(
    {
      time_s: ordered.map((t) => t.time_s),
      learner_steps: ordered.map((t) => t.learner_step),
      test: ordered.map((t) => 100 * t.success_rate),
      low: ordered.map((t) => 100 * t.success_interval[0]),
      high: ordered.map((t) => 100 * t.success_interval[1]),
    },
    axis,
  );
  const success = joined([
    { x: own.x, training: own.training },
    { x: each.x, test: each.test, low: each.low, high: each.high },
  ]);
  return { own, success, scores: { x: scores.x, score: scores.score } };
}

// The set of columns that a figure is drawn from.
export function columnsOf(figure, { own, success, scores }) {
  if (figure.title === "Success") return success;
  return figure.title === "Score of an episode" ? scores : own;
}
