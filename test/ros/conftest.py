# SPDX-License-Identifier: Apache-2.0
"""Nodes for the tests of a module."""

import contextlib

import pytest

pytest.register_assert_rewrite('rig')


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Return a function that makes a fresh folder."""
    return lambda: tmp_path_factory.mktemp('node')


@pytest.fixture(scope='module')
def stack():
    """Return an exit stack that lives as long as the module's tests."""
    with contextlib.ExitStack() as exit_stack:
        yield exit_stack


@pytest.fixture(scope='module')
def client(stack):
    from rig import Client

    return stack.enter_context(Client())


@pytest.fixture(scope='module')
def start(stack, folder):
    """Return a function that starts a node's process."""
    from rig import node_process

    return lambda *arguments: stack.enter_context(node_process(folder(), *arguments))
