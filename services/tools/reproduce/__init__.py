"""The paper's tables and figures, over seeds."""
