"""An arm of two links in a loop of 1 kHz whose log holds every second to tenth tick, by exact equations."""

import numpy as np

from truth.arm.two_links import run_sampled
from truth.arm.two_links_case import drawn_links, friction_lines, plant_lines
from truth.axis.machines import multisine

RATE = 1000.0
_TONES = (0.2, 0.5, 0.9, 1.7)  # Hz
_KP, _KD = (300.0, 150.0), (30.0, 10.0)
_COUNT = 2 * np.pi / 2**17


def slow_arm(
    seed: int, log_rate: float, noise: int | None = None
) -> tuple[str, dict[str, np.ndarray], dict[str, float]]:
    """Return case, columns and truth of an arm under weight that follows sines for 12 s.

    Its loop differentiates encoders of 17 bits. The case states neither controller nor sensor, and its
    guesses are half as large again as the truth, or smaller by as much.

    Args:
        seed: Number that the arm, its motion and its guesses are drawn with.
        log_rate: Rows a second [Hz], a divisor of 1000.
        noise: Number that the noise is drawn with; None: the seed.
    """
    random = np.random.default_rng([44, seed])
    links, true = drawn_links(random)

    times = np.arange(round(12.0 * RATE)) / RATE
    reference = np.stack([multisine(times, list(_TONES), 1.2, 2 * seed + k) for k in range(2)], axis=1)
    run = run_sampled(
        links,
        rate=RATE,
        start=reference[0],
        reference=reference,
        kp=_KP,
        kd=_KD,
        resolution=_COUNT,
        noise=0.5 * _COUNT,
        force_noise=0.05,
        seed=seed if noise is None else noise,
    )

    off = dict(zip(true, (1.5 ** random.choice([-1.0, 1.0], len(true))).tolist(), strict=True))
    guess = lambda name: f"{{ guess = {true[name] * off[name]!r} }}"
    lines = plant_lines(links, guess)
    lines += friction_lines(guess)
    lines += ["[log]", 'time = "t"', 'position = ["q1", "q2"]', 'force = ["u1", "u2"]']
    every = round(RATE / log_rate)
    return "\n".join(lines) + "\n", {name: x[::every] for name, x in run.items()}, true
