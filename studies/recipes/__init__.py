# SPDX-License-Identifier: Apache-2.0
"""Recipes of docs/, one a file: this observer and the usual peers on data with the truth."""
