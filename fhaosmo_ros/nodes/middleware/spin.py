# SPDX-License-Identifier: Apache-2.0
"""Starting, spinning and stopping a node: what both nodes' `main` share."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
import gc
from itertools import pairwise
import os
import re
import sys
import textwrap
import threading
import traceback
from typing import Any

from fhaosmo_ros import __version__
from fhaosmo_ros.core.parameters.declaration import (
    Parameter,
    shown,
    suggestion,
    unknown_parameter,
)
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import (
    check_one_type,
    is_built_in,
    read,
    with_origin,
)
from fhaosmo_ros.core.parameters.tables import FIRST, NODE_TABLES
from fhaosmo_ros.core.parameters.yaml_text import parse
from fhaosmo_ros.nodes.middleware.lifecycle import ManagedNode
from fhaosmo_ros.stop_signals import stop_on_signals, Stopped
import rclpy
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import remove_ros_args

try:
    from rclpy.experimental import EventsExecutor
except ImportError:  # an older rclpy
    EventsExecutor = None

GRACE = 0.5
"""Seconds that a callback has to end after a signal."""
FOREVER = 3600.0
"""
Seconds. Without a finite timeout, the events executor of the PyPI wheels (rclpy 7.1) never runs a
callback and keeps a core busy.
"""
TABLES = tuple(NODE_TABLES.values())


def make_executor(context: Any) -> Any:
    """
    Return the events executor where rclpy has it, else the single-threaded one.

    Measured with a timer, three publishers and a subscription at 1 kHz: the events executor takes
    12 to 14 % of a core and delivers a sample in 0.13 ms (median); the single-threaded one takes
    64 to 76 % and 0.19 to 0.25 ms. The multi-threaded one runs the timer at 2 to 73 Hz only.
    """
    kind = EventsExecutor or SingleThreadedExecutor
    return kind(context=context)


class Spinner:
    """
    Runs an executor in a thread of its own while it is open.

    The usual main (`rclpy.init`, ``executor.spin()``, except KeyboardInterrupt) does not work with
    the events executor of the PyPI wheels (rclpy 7.1): on SIGINT and SIGTERM it hung 24 times of
    24, and its `spin` without a timeout runs no callback. So the executor spins in this thread,
    with a finite timeout and until a future is done; the main thread waits for signals, because
    Python runs signal handlers there only; `wake` makes the executor look at the future.

    Parameters
    ----------
    *nodes : Node
        All of one context.
    on_end : callable
        Called in the executor's thread when it ends, also by the error of a callback.

    Attributes
    ----------
    error : BaseException or None
        What a callback raised.

    """

    def __init__(self, *nodes: Node, on_end: Callable[[], None] = lambda: None) -> None:
        self.error: BaseException | None = None
        self._on_end = on_end
        self._logger = nodes[0].get_logger()
        self._executor = make_executor(nodes[0].context)
        for node in nodes:
            self._executor.add_node(node)
        self._stop = Future()
        self._thread = threading.Thread(target=self._spin, name='executor', daemon=True)

    def __enter__(self) -> 'Spinner':
        # What there is now lives to the end, so garbage collections need not look at it. One that
        # does takes 70 ms, in which the middleware waits for Python and drops messages.
        gc.collect()
        gc.freeze()
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
        """True if a callback is still running after the end of the block."""
        return self._thread.is_alive()

    def _spin(self) -> None:
        try:
            while not self._stop.done():
                try:
                    self._executor.spin_until_future_complete(self._stop, timeout_sec=FOREVER)
                except InvalidHandle:
                    # The events executor of rclpy 7.1 still calls a service that was destroyed
                    # while its request waited, and then cannot send the answer. The
                    # single-threaded executor passes over such requests by itself.
                    self._logger.warning(
                        'dropped a request to a service that was destroyed meanwhile',
                        throttle_duration_sec=5.0,
                    )
        except ExternalShutdownException:
            pass
        except BaseException as error:
            if not self._stop.done():
                self.error = error
        finally:
            self._on_end()


def run_node(name: str, factory: Callable[..., Node], argv: list[str] | None) -> int:
    """
    Run a node, made with the options of rclpy's Node, until SIGINT, SIGTERM or SIGHUP.

    rclpy's own signal handlers are off: SIGINT would come out of the events executor as a
    RuntimeError, and a second Ctrl-C would cut the clean-up short. See `Spinner` and
    `stop_on_signals`.

    Returns
    -------
    int
        Exit code: 0 after a signal, 1 if a callback failed, 2 for a bad configuration (said in
        one line on stderr).

    """
    argv = sys.argv[1:] if argv is None else argv
    for flag, text in (
        ('-h', help_text), ('--help', help_text), ('--help-parameters', all_parameters),
        ('--version', lambda _: f'fhaosmo_ros {__version__}'),
    ):  # fmt: skip
        if flag in argv:
            print(text(name))
            return 0
    ended = stop_on_signals()
    node = None
    origins: dict[str, str | None] = {}
    try:
        with ended.raising(GRACE):  # one import can last for a second
            origins, lists = _check_arguments(name, argv)
            rclpy.init(args=[name, *argv], signal_handler_options=SignalHandlerOptions.NO)
            overrides = [RosParameter(name, value=value) for name, value in lists.items()]
            node = factory(parameter_overrides=overrides) if overrides else factory()
        with Spinner(node, on_end=ended.set) as spinner:
            ended.wait()
        if spinner.stuck:  # a node has nothing to save
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
        if isinstance(error, ConfigurationError):
            error = with_origin(error, origins)
        print(f'{name}: error: {_one_line(error)}', file=sys.stderr)
        return 2
    finally:
        if node is not None:
            if isinstance(node, ManagedNode):
                node.stop()
            node.destroy_node()
        rclpy.try_shutdown()


def _check_arguments(
    name: str, argv: list[str]
) -> tuple[dict[str, str | None], dict[str, list[Any]]]:
    """
    Refuse what rcl ignores silently or refuses without saying which parameter is wrong.

    Values are left to the node, which gets them from rcl and checks them once.

    Returns
    -------
    origins : dict
        Where each parameter comes from, by name: the file, or None for the command line.
    lists : dict
        Lists that take the place of single values: of these, rcl returns the single one.

    """
    options = list(pairwise(argv))
    full_name = _full_name(name, options)
    origins: dict[str, str | None] = {}
    latest: dict[str, Any] = {}
    single: set[str] = set()
    for path in (os.path.expanduser(word) for flag, word in options if flag == '--params-file'):
        values = read(path, full_name)
        if not values:
            get_logger(name).warning(f'{path}: sets nothing for node {full_name}')
        for parameter, value in values.items():
            try:
                _check_form(parameter, value)
            except ConfigurationError as error:
                raise ConfigurationError(f'{path}: {error}') from None
            origins[parameter] = path
        latest |= values
        single |= {key for key, value in values.items() if not isinstance(value, list)}
    for parameter, text in _on_command_line(options, full_name):
        # The node gets no other node's parameters of one command line, but may of one file.
        if '.' not in parameter and parameter not in NODE_TABLES[name]:
            raise ConfigurationError(
                f"unknown parameter '{parameter}'{suggestion(parameter, NODE_TABLES[name])}"
            )
        try:
            value = parse(text)
        except ConfigurationError as error:
            raise ConfigurationError(f"parameter '{parameter}': {error}") from None
        check_one_type(parameter, value)
        _check_form(parameter, value)
        origins[parameter], latest[parameter] = None, value
        if not isinstance(value, list):
            single.add(parameter)
    rest = remove_ros_args([name, *argv])[1:]
    if rest:
        raise ConfigurationError(f'unexpected argument {rest[0]!r}; {_usage(name)}')
    return origins, {k: v for k, v in latest.items() if isinstance(v, list) and k in single}


def _on_command_line(options: list[tuple[str, str]], full_name: str) -> Iterator[tuple[str, str]]:
    """Yield names and texts of the parameters that -p sets for a node."""
    for flag, word in options:
        target, separator, text = word.partition(':=')
        node, _, parameter = target.rpartition(':')
        ours = not node or node == full_name.rsplit('/', 1)[-1]
        if flag in ('-p', '--param') and separator and ours and not is_built_in(parameter):
            yield parameter, text


def _check_form(name: str, value: Any) -> None:
    """Refuse a parameter without a value, an empty list, and a list of lists."""
    empty = value is None or value == []
    if empty or (isinstance(value, list) and isinstance(value[0], list | dict)):
        own = name, name.partition('.')[2]  # of the node, or of a channel
        declared = [table[part] for part in own for table in TABLES if part in table]
        if not declared:
            raise unknown_parameter(name, [other for table in TABLES for other in table])
        raise replace(declared[0], name=name).error(value)


def _full_name(name: str, options: list[tuple[str, str]]) -> str:
    """Return the node's name after the renaming that the command line asks for."""
    parts = {'name': name, 'ns': ''}
    for flag, word in options:
        rule = re.fullmatch(r'(?:[^:]+:)?__(node|name|ns):=(.+)', word)
        if flag in ('-r', '--remap') and rule:
            parts['ns' if rule[1] == 'ns' else 'name'] = rule[2]
    return f'{parts["ns"].rstrip("/")}/{parts["name"]}'


def help_text(name: str) -> str:
    """Return the usage of a node and the parameters that matter first, with their defaults."""
    first = [p for p in NODE_TABLES[name].values() if p.name in FIRST]
    return '\n'.join([
        f'usage: {name} [--ros-args [--params-file FILE] [-p NAME:=VALUE] [-r FROM:=TO] ...]',
        '', 'The parameters that matter first, and their defaults:', '', *_lines(first), '',
        f'All of them: {name} --help-parameters; docs/parameters.md says more.',
    ])  # fmt: skip


def all_parameters(name: str) -> str:
    """Return all parameters of a node with their defaults, what is allowed, and what they do."""
    table = NODE_TABLES[name]
    return '\n'.join(_lines([*table.values(), *table.families]))


def _lines(parameters: Iterable[Parameter]) -> Iterator[str]:
    for p in parameters:
        yield f'{p.name}: {shown(p.default)}'
        indent = ' ' * 4
        text = f'{p.text} ({p.allowed})'
        yield from textwrap.wrap(text, 99, initial_indent=indent, subsequent_indent=indent)


def _usage(name: str) -> str:
    return (
        f'usage: {name} [--ros-args [--params-file FILE] [-p NAME:=VALUE] [-r FROM:=TO] ...]; '
        f'parameters: {name} --help'
    )


def _one_line(error: BaseException) -> str:
    text = ' '.join(str(error).split())
    if type(error).__name__ == 'UnknownROSArgsError':
        return f'unknown ROS arguments {text}'
    return re.sub(r', at \S+:\d+', '', text)  # rcl's own source lines
