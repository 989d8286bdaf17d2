# SPDX-License-Identifier: Apache-2.0
"""Shapes of d that no family of `tune` has; the studies judge by them."""

import math

from fhaosmo_ros.core.simulation.metrics import rms
from fhaosmo_ros.core.simulation.recordings import Floats
import numpy as np
from scipy.signal import lfilter, sawtooth

BREAK_AWAY, KINETIC = 0.8, 0.4  # friction of `stick-slip`, relative to the force that drives it
BLOW = 0.2  # length of an impulse, in 1 / omega


def wave(kind: str, t: Floats, omega: float, random: np.random.Generator) -> Floats:
    """
    Return a signal of unit RMS that moves at about `omega` rad/s, at evenly spaced times (s).

    'ou' is first-order noise (Ornstein-Uhlenbeck), 'pulses' are Gaussian bells, 'impulses' short
    blows, and 'stick-slip' is a friction that holds a sine until it breaks away.
    """
    phase = random.uniform(0.0, 2.0 * np.pi)
    angle = omega * t + phase
    if kind == 'sine':
        d = np.sin(angle)
    elif kind == 'square':
        d = np.sign(np.sin(angle))
    elif kind == 'sawtooth':
        d = sawtooth(angle)
    elif kind == 'stick-slip':
        force = np.sin(angle)
        d = np.where(np.abs(force) < BREAK_AWAY, force, KINETIC * np.sign(force))
    elif kind == 'chirp':  # from 0.3 to 2 omega
        d = np.sin(omega * t * (0.3 + 0.85 * t / t[-1]) + phase)
    elif kind == 'ou':
        d = lfilter([1.0], [1.0, -math.exp(-omega * t[1])], random.standard_normal(len(t)))
    elif kind == 'impulses':
        begins = np.arange(-random.uniform(0.0, np.pi) / omega, t[-1], np.pi / omega)
        blows = random.uniform(0.5, 1.5, len(begins)) * random.choice([-1.0, 1.0], len(begins))
        number = np.searchsorted(begins, t, side='right') - 1
        d = np.where(t - begins[number] < BLOW / omega, blows[number], 0.0)
    else:
        d = np.zeros(len(t))
        for middle in np.arange(random.uniform(0.0, 3.0), t[-1], 2.6 * np.pi / omega):
            d += random.standard_normal() * np.exp(-0.5 * (1.5 * omega * (t - middle)) ** 2)
    return np.asarray(d / rms(d))
