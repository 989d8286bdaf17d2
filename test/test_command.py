# SPDX-License-Identifier: Apache-2.0
"""The protocol of all commands: exit codes, one-line errors, signals, outputs, processes."""

import argparse
from contextlib import suppress
from errno import ENOSPC
from pathlib import Path
import signal
import sys

import commands
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.stop_signals import Stop, stop_on_signals, Stopped
from fhaosmo_ros.tools.cli.command import output_at, run_command
import pytest

PARSER = argparse.ArgumentParser(prog='try')


@pytest.mark.parametrize(('error', 'code', 'said'), [
    (ConfigurationError('wrong'), 2, 'error: wrong\n'),
    (FileNotFoundError(2, 'No such file', 'x'), 2, 'error: No such file: x\n'),
    (ConfigurationError("'sql://u:p@ss@h/db': no"), 2, "error: 'sql://u:***@h/db': no\n"),
    (Stopped('nothing written'), 130, 'interrupted, nothing written\n'),
])  # fmt: skip
def test_errors_are_one_line_and_have_their_exit_code(capsys, error, code, said):
    def body(arguments, stop):
        raise error

    assert run_command(PARSER, [], body) == code
    assert capsys.readouterr().err == f'try: {said}'


def test_body_gets_its_arguments_and_its_code_is_returned():
    """Those of ROS are apart, as launch files give them to all programs; no password is kept."""
    parser = argparse.ArgumentParser(prog='try')
    parser.add_argument('--storage')
    url, of_ros = 'postgresql://u:p@ss@h/db', ['-r', '__node:=x']

    def body(arguments, stop):
        assert (arguments.storage, arguments.ros_arguments) == (url, of_ros)
        assert arguments.command_line.endswith('x -- --storage postgresql://u:***@h/db')
        return 7

    assert run_command(parser, ['--ros-args', *of_ros, '--', '--storage', url], body) == 7
    assert run_command(parser, ['--ros-args', *of_ros], lambda arguments, stop: None) == 0


@pytest.mark.signals
@pytest.mark.filterwarnings('ignore::pytest.PytestUnraisableExceptionWarning')
@pytest.mark.parametrize('in_destructor', [False, True])
def test_a_signal_cuts_only_what_may_be_cut_and_only_once(in_destructor, capsys):
    class Collected:
        def __del__(self):
            signal.raise_signal(signal.SIGTERM)

    cleaned = []

    def body(arguments, stop):
        with stop.raising():
            try:
                if in_destructor:
                    Collected()  # Python drops what a signal raises there
                else:
                    signal.raise_signal(signal.SIGTERM)
                    pytest.fail('went on')
            finally:
                signal.raise_signal(signal.SIGTERM)
                cleaned.append(True)

    assert run_command(PARSER, [], body) == 130
    assert cleaned
    assert capsys.readouterr().err == 'try: interrupted\n'
    stop = Stop()
    stop.signal()
    with pytest.raises(Stopped), stop.raising():
        pytest.fail('the signal came before')


def test_output_replaces_only_what_is_empty_or_forced_and_only_when_it_is_complete(tmp_path):
    final = tmp_path / 'out'
    final.mkdir()
    for force, text in ((False, 'new'), (True, 'newer')):
        with output_at(final, force) as path:
            path.write_text(text)
            with suppress(Stopped), output_at(final, force):  # as another process at that time
                raise Stopped
        assert final.read_text() == text
    with suppress(Stopped), output_at(final, force=True) as path:
        path.write_text('half')
        assert path.parent.name.startswith('out.')  # not hidden, as it stays after a kill
        raise Stopped
    assert final.read_text() == 'newer'
    with pytest.raises(ConfigurationError, match='--force'), output_at(final):
        pass
    for given in (ENOSPC, 'No space'), ('No space',):  # some libraries give no number
        with pytest.raises(OSError, match=f'No space.*{final}'), output_at(final, force=True):
            raise OSError(*given)
    assert [p.name for p in tmp_path.iterdir()] == ['out']
    for place, inputs, why in (Path('..'), [], 'in use'), (tmp_path, [final], 'the input'):
        with pytest.raises(ConfigurationError, match=why), output_at(place, True, *inputs):
            pass


SLOW = """
import sys
from fhaosmo_ros.__main__ import COMMANDS, main
sys.path.insert(0, sys.argv[1])
COMMANDS['slow'] = ('slow', '')
raise SystemExit(main(['slow']))
"""
# Naps: Python handles a signal that comes just before a sleep only after that.
LOADS = 'import time\nprint("begun", flush=True)\nfor _ in range(6000):\n    time.sleep(0.1)\n'
WORKS = """
import argparse, time, warnings
from pathlib import Path
from fhaosmo_ros.tools.cli.command import output_at, run_command

def body(arguments, stop):
    with output_at(Path(__file__).with_name('out')) as path, stop.raising():
        path.mkdir()
        warnings.filterwarnings('always', 'odd')
        for _ in range(2):
            warnings.warn('odd')
        print('begun', flush=True)
        for _ in range(6000):
            time.sleep(0.1)

def main(argv):
    return run_command(argparse.ArgumentParser(prog='slow'), argv, body)
"""


@pytest.mark.signals
@pytest.mark.parametrize(('number', 'ignored'), [
    (signal.SIGINT, False),  # Ctrl-C in a terminal
    (signal.SIGINT, True),  # kill -INT of a script's background job
    (signal.SIGTERM, True),  # timeout(1)
    (signal.SIGHUP, False),  # the terminal or the SSH connection closes
])  # fmt: skip
@pytest.mark.parametrize('module', [LOADS, WORKS], ids=['loads', 'works'])
def test_signal_ends_a_command_that_loads_or_works(tmp_path, module, number, ignored):
    def disposition():
        signal.signal(signal.SIGINT, signal.SIG_IGN if ignored else signal.default_int_handler)
        signal.signal(signal.SIGHUP, signal.SIG_DFL)  # these tests under nohup ignore it

    (tmp_path / 'slow.py').write_text(module)
    python = {'command': [sys.executable], 'preexec_fn': disposition}
    with commands.start('-c', SLOW, tmp_path, **python) as process:
        try:
            assert process.stdout.readline() == 'begun\n'
            process.send_signal(number)
            _, error = process.communicate(timeout=60)
        finally:
            process.kill()
    said = '' if module == LOADS else 'slow: warning: odd\nslow: interrupted\n'
    assert (process.returncode, error) == (130, said)
    assert {p.name for p in tmp_path.iterdir()} <= {'slow.py', '__pycache__'}


@pytest.mark.signals
def test_what_nohup_started_goes_on():
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    stop = stop_on_signals()
    signal.raise_signal(signal.SIGHUP)
    assert not stop.is_set()
