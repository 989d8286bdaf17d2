# SPDX-License-Identifier: Apache-2.0
"""`tune`: finds parameters of the estimator that fit a sensor, a plant and a kind of d."""
