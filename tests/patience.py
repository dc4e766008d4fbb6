"""How long a test waits for what should happen at once: the one bound, for tests of all kinds.

It only ends a test that would wait forever, and is never the verdict. Every core may have ten
others to serve.
"""

PATIENCE_S = 300.0
