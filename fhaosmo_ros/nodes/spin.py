# SPDX-License-Identifier: Apache-2.0
"""Starting, spinning and stopping a node: what both nodes' `main` share."""

from collections.abc import Callable, Mapping
import contextlib
import gc
from itertools import pairwise
import os
import re
import sys
import threading
import traceback
from typing import Any

from fhaosmo_ros.core.channel_parameters import channel_names, CHANNELS, with_channels
from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.parameter import Parameter, suggestion
from fhaosmo_ros.core.parameter_file import check_one_type, is_built_in, load, parse, read
from fhaosmo_ros.core.parameters import NODE_TABLES
from fhaosmo_ros.nodes.lifecycle import ManagedNode
from fhaosmo_ros.stop_signals import stop_on_signals, Stopped
import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import remove_ros_args
import yaml

try:
    from rclpy.experimental import EventsExecutor
except ImportError:  # an older rclpy
    EventsExecutor = None

GRACE = 0.5
"""Seconds that a callback has to end."""
FOREVER = 3600.0
"""The events executor never runs a callback without a finite timeout."""


def make_executor(context: Any) -> Any:
    """
    Return the events executor where rclpy has it, else the single-threaded one.

    At 1 kHz the events executor needs about a fifth of the single-threaded one's CPU.
    """
    kind = EventsExecutor or SingleThreadedExecutor
    return kind(context=context)


class Spinner:
    """
    Runs an executor in a thread of its own.

    Python's signal handlers run in the main thread only, which the executor must not block.
    """

    def __init__(self, *nodes: Node, on_end: Callable[[], None] = lambda: None) -> None:
        self.error: BaseException | None = None
        self._on_end = on_end
        self._executor = make_executor(nodes[0].context)
        for node in nodes:
            self._executor.add_node(node)
        self._stop = Future()
        self._thread = threading.Thread(target=self._spin, name='executor', daemon=True)

    def __enter__(self) -> 'Spinner':
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set_result(None)
        self._executor.wake()
        self._thread.join(timeout=GRACE)
        if not self.stuck:
            self._executor.shutdown()

    @property
    def stuck(self) -> bool:
        """True if a callback runs still, after the end of the block."""
        return self._thread.is_alive()

    def _spin(self) -> None:
        try:
            while not self._stop.done():
                self._executor.spin_until_future_complete(self._stop, timeout_sec=FOREVER)
        except ExternalShutdownException:
            pass
        except BaseException as error:
            if not self._stop.done():
                self.error = error
        finally:
            self._on_end()


def run_node(name: str, factory: Callable[[], Node], argv: list[str] | None) -> int:
    """
    Run a node until SIGINT or SIGTERM.

    Returns
    -------
    int
        Exit code: 0 after a signal, 1 if a callback failed, 2 for a bad configuration (said in
        one line on stderr).

    """
    argv = sys.argv[1:] if argv is None else argv
    if any(word in ('-h', '--help') for word in argv):
        print(_usage(name))
        return 0
    ended = stop_on_signals()
    node = None
    try:
        with ended.raising(GRACE):  # the start may compile for seconds
            _check_arguments(name, argv)
            rclpy.init(args=[name, *argv], signal_handler_options=SignalHandlerOptions.NO)
            node = factory()
        gc.collect()
        gc.freeze()  # what lives now lives to the end: later collections need not visit it
        with Spinner(node, on_end=ended.set) as spinner:
            ended.wait()
        if spinner.stuck:  # for instance compiling; a node has nothing to save
            print(f'{name}: ended while a callback was running', file=sys.stderr, flush=True)
            os._exit(0)
        if spinner.error is not None:
            print(f'{name}: error: a callback failed', file=sys.stderr)
            traceback.print_exception(spinner.error)
            return 1
        return 0
    except Stopped:
        return 0
    except (ConfigurationError, RuntimeError) as error:
        print(f'{name}: error: {_one_line(error)}', file=sys.stderr)
        return 2
    finally:
        if node is not None:
            if isinstance(node, ManagedNode):
                node.stop()
            node.destroy_node()
        rclpy.try_shutdown()


def _check_arguments(name: str, argv: list[str]) -> None:
    """Check what rcl would pass over in silence, or refuse without naming what is wrong."""
    options = list(pairwise(argv))
    full_name = _full_name(name, options)
    table = with_channels(NODE_TABLES[name], _channels(options, full_name))
    for flag, word in options:
        if flag == '--params-file':
            load(os.path.expanduser(word), full_name, table)
        elif flag in ('-p', '--param') and ':=' in word:
            target, text = word.split(':=', 1)
            node, _, parameter = target.rpartition(':')
            if node and node != full_name.rsplit('/', 1)[-1]:
                continue  # another node's
            if parameter not in table and not is_built_in(parameter):
                raise ConfigurationError(
                    f"unknown parameter '{parameter}'{suggestion(parameter, table)}"
                )
            _check_text(parameter, text, table)
    rest = remove_ros_args([name, *argv])[1:]
    if rest:
        raise ConfigurationError(f'unexpected argument {rest[0]!r}; {_usage(name)}')


def _channels(options: list[tuple[str, str]], full_name: str) -> list[str]:
    """Return the channels that the arguments declare, wherever they do."""
    values: dict[str, Any] = {}
    for flag, word in options:
        if flag == '--params-file':
            with contextlib.suppress(ConfigurationError):  # `load` says it
                values |= read(os.path.expanduser(word), full_name)
    for flag, word in options:
        target, _, text = word.partition(':=')
        if flag in ('-p', '--param') and target.rsplit(':', 1)[-1] == CHANNELS:
            with contextlib.suppress(yaml.YAMLError):  # rcl quotes the whole rule
                values[CHANNELS] = parse(text)
    return channel_names(values)


def _full_name(name: str, options: list[tuple[str, str]]) -> str:
    """Return the node's name after the renaming that the command line asks for."""
    parts = {'name': name, 'ns': ''}
    for flag, word in options:
        rule = re.fullmatch(r'(?:[^:]+:)?__(node|name|ns):=(.+)', word)
        if flag in ('-r', '--remap') and rule:
            parts['ns' if rule[1] == 'ns' else 'name'] = rule[2]
    return f'{parts["ns"].rstrip("/")}/{parts["name"]}'


def _check_text(name: str, text: str, table: Mapping[str, Parameter]) -> None:
    """Check the lists that rcl or rclpy would refuse without naming the parameter."""
    try:
        value = parse(text)
    except yaml.YAMLError:
        return  # rcl quotes the whole rule
    check_one_type(name, value)
    if value == [] and name in table:
        raise table[name].error(value)


def _usage(name: str) -> str:
    return (
        f'usage: {name} [--ros-args [--params-file FILE] [-p NAME:=VALUE] [-r FROM:=TO] ...]; '
        'parameters are listed in docs/parameters.md'
    )


def _one_line(error: BaseException) -> str:
    text = ' '.join(str(error).split())
    if type(error).__name__ == 'UnknownROSArgsError':
        return f'unknown ROS arguments {text}'
    return re.sub(r', at \S+:\d+', '', text)  # rcl's own source lines
