# SPDX-License-Identifier: Apache-2.0
"""
A known delay of y: the inputs that acted when it was measured, and estimates of the present.

A sample that arrives at t tells of the plant at t - `measurement_delay`; its stamp remains t for
the rules of time. A known input that arrives at t acted at t - `input_delay`. So the step to a
sample needs the inputs that arrived a lag of measurement_delay - input_delay before it.
"""

from libc.string cimport memcpy

from fhaosmo_ros.core.model.prediction cimport Prediction

import numpy as np

NANOSECONDS = 1e-9
cdef int MOST_PIECES = 512
PIECES = MOST_PIECES
"""Room for so many different values of the inputs within the delay; older ones are forgotten."""


cdef class PastInputs:
    """
    The known inputs of late; pieces of time with the same inputs are one.

    Parameters
    ----------
    inputs : int
    late : bool
        y is known later than the inputs, so that their past matters.

    """

    def __cinit__(self, int inputs, bint late):
        cdef double[::1] latest = np.zeros(inputs)
        cdef double[:, ::1] pieces = np.zeros((MOST_PIECES if late else 0, 1 + inputs))
        self.inputs, self.is_late, self.pieces = inputs, late, np.asarray(pieces)
        self.latest, self.present = np.asarray(latest), &latest[0]
        if late:
            self.first = &pieces[0, 0]

    cdef double* piece(self, int back) noexcept nogil:
        """Return a piece, by its number from the latest one back."""
        cdef int place = (self.ring.past_place + MOST_PIECES - back) % MOST_PIECES
        return self.first + place * (1 + self.inputs)

    cdef void note(self, long long elapsed, const double* u) noexcept nogil:
        """Append that the inputs have been `u` for the latest `elapsed` nanoseconds."""
        cdef double* latest = self.piece(0)
        cdef bint same = self.ring.past_count > 0
        cdef int j
        for j in range(self.inputs):
            same = same and latest[1 + j] == u[j]
        if not same:
            self.ring.past_place = (self.ring.past_place + 1) % MOST_PIECES
            self.ring.past_count = min(self.ring.past_count + 1, MOST_PIECES)
            latest = self.piece(0)
            latest[0] = 0.0
            memcpy(latest + 1, u, self.inputs * sizeof(double))
        latest[0] += elapsed

    cdef void withdraw(self, long long elapsed) noexcept nogil:
        """Take back what `note` has appended last."""
        self.piece(0)[0] -= elapsed
        if self.piece(0)[0] <= 0.0:
            self.ring.past_place = (self.ring.past_place + MOST_PIECES - 1) % MOST_PIECES
            self.ring.past_count -= 1

    cdef const double* before(
        self, long long lag, long long elapsed, const double* u
    ) noexcept nogil:
        """
        Return the mean of the inputs over `elapsed` nanoseconds that ended `lag` before now.

        They are `u` where nothing is known of the past.
        """
        cdef long long covered = 0, end = 0, begin, share  # end of a piece, before now
        cdef int k, j
        cdef double part
        cdef const double* piece
        memcpy(self.acting, u, self.inputs * sizeof(double))
        for k in range(self.ring.past_count):
            piece = self.piece(k)
            begin = end + <long long>piece[0]
            share = min(begin, lag + elapsed) - max(end, lag)
            if k == self.ring.past_count - 1:  # the oldest one known stands for all before it
                share = elapsed - covered
            if share > 0:
                covered += share
                part = <double>share / covered
                for j in range(self.inputs):
                    if part == 1.0:
                        self.acting[j] = piece[1 + j]
                    else:
                        self.acting[j] += part * (piece[1 + j] - self.acting[j])
            if covered >= elapsed:
                break
            end = begin
        return self.acting

    cdef void carry(self, Prediction prediction, long long lag, long long delay) noexcept nogil:
        """Follow the model over the delay, by the inputs that have acted since."""
        cdef int known = 0
        cdef long long age = 0, left = lag  # until now: from the end of a piece; to be predicted
        if lag > 0 and self.ring.past_count > 0:
            while known + 1 < self.ring.past_count and age + <long long>self.piece(known)[0] < lag:
                age += <long long>self.piece(known)[0]
                known += 1
            while known >= 0:  # from the oldest piece within the lag to the latest one
                if left > age:
                    prediction.over((left - age) * NANOSECONDS, self.piece(known) + 1)
                left = age
                known -= 1
                if known >= 0:
                    age -= <long long>self.piece(known)[0]
            delay -= lag
        if delay > 0:
            prediction.over(delay * NANOSECONDS, self.present)
