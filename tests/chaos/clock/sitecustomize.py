"""Imported by Python at its start: a wall clock that is CHAOS_CLOCK_SHIFT_S seconds ahead."""

import os
import time

_shift_ns = int(float(os.environ["CHAOS_CLOCK_SHIFT_S"]) * 1e9)
_time_ns = time.time_ns
time.time_ns = lambda: _time_ns() + _shift_ns
time.time = lambda: time.time_ns() / 1e9
