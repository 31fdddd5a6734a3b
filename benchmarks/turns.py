"""Functions timed in turns, so that what else the machine does meets all of them alike."""

import time

import numpy as np


def in_turns(benchmark, functions, *, rounds=15, calls=1):
    """The median time of each, in milliseconds: printed with its quartiles and the least, and
    kept with the run.

    A turn is of several calls where another's threads still spin at its start: then only its
    second half counts. (Twice the time at the first call after OpenCV, nothing after some ten.)
    The benchmark's own figure is the time of a whole round.
    """
    times = {name: [] for name in functions}

    def one_round():
        for name, function in functions.items():
            turn = []
            for _ in range(calls):
                start = time.perf_counter()
                function()
                turn.append(time.perf_counter() - start)
            times[name].append(turn[calls // 2 :])

    benchmark.pedantic(one_round, rounds=rounds, warmup_rounds=1)
    # Without the round that warms up.
    spread = {
        name: 1e3 * np.percentile(each[1:], (50, 25, 75, 0)) for name, each in times.items()
    }
    milliseconds = {name: float(each[0]) for name, each in spread.items()}
    benchmark.extra_info |= milliseconds
    for name, (median, low, high, least) in spread.items():
        print(f"\n{name}: {median:.2f} ms ({low:.2f} to {high:.2f}, least {least:.2f})", end="")
    print()
    return milliseconds
