"""The arena behind the APIs of PettingZoo, Gymnasium and stable-baselines3."""
