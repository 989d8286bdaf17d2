# SPDX-License-Identifier: Apache-2.0
"""The protocol of all commands: exit codes, one-line errors, signals, outputs, processes."""

import argparse
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.stop_signals import Stopped
from fhaosmo_ros.tools.cli.command import Interrupted, run_command
from fhaosmo_ros.tools.cli.output import Output
from fhaosmo_ros.tools.cli.progress import progress
import pytest

ROOT = Path(__file__).resolve().parents[1]
PARSER = argparse.ArgumentParser(prog='try')
BUSY = """
import argparse, os, signal, sys, time
from pathlib import Path
from fhaosmo_ros.tools.cli.command import run_command
from fhaosmo_ros.tools.cli.output import Output
from studies.harness import called

def work(folder, k):
    # Only the parent takes Ctrl-C, however busy the machine is.
    assert {signal.SIGINT, signal.SIGHUP} <= signal.pthread_sigmask(signal.SIG_BLOCK, ())
    (folder / f'{k}.pid').write_text(str(os.getpid()))
    time.sleep(600)

def body(arguments, stop):
    folder = Path(sys.argv[1])
    with Output(folder / 'out') as output:
        output.path.mkdir()
        called({k: (work, folder, k) for k in range(2)}, 'busy', 2, stop)

if __name__ == '__main__':
    parser = argparse.ArgumentParser(prog='busy')
    parser.add_argument('folder')
    sys.exit(run_command(parser, None, body))
"""


def run(capsys, error):
    def body(arguments, stop):
        raise error

    code = run_command(PARSER, [], body)
    return code, capsys.readouterr().err


@pytest.mark.parametrize(
    ('error', 'code', 'said'),
    [
        (ConfigurationError('wrong'), 2, 'try: error: wrong\n'),
        (FileNotFoundError(2, 'No such file', 'x'), 2, 'try: error: No such file: x\n'),
        (Interrupted('nothing written'), 130, 'try: interrupted, nothing written\n'),
        (Stopped(), 130, 'try: interrupted\n'),
    ],
)
def test_errors_are_one_line_and_have_their_exit_code(capsys, error, code, said):
    assert run(capsys, error) == (code, said)


def test_other_errors_keep_their_trace(capsys):
    with pytest.raises(ZeroDivisionError):
        run(capsys, ZeroDivisionError())


def test_body_gets_arguments_and_its_code_is_returned():
    parser = argparse.ArgumentParser(prog='try')
    parser.add_argument('--number', type=int)
    seen = []

    def body(arguments, stop):
        seen.append((arguments.number, arguments.command_line, stop.is_set()))
        return 7

    assert run_command(parser, ['--number', '3'], body) == 7
    assert seen == [(3, 'try --number 3', False)]
    assert run_command(parser, [], lambda arguments, stop: None) == 0


def test_passwords_of_urls_are_not_said(capsys):
    def body(arguments, stop):
        assert 'postgresql://u:***@h/db' in arguments.command_line
        raise ConfigurationError("storage 'postgresql://u:p@ss@h/db': no answer")

    parser = argparse.ArgumentParser(prog='try')
    parser.add_argument('--storage')
    assert run_command(parser, ['--storage', 'postgresql://u:p@ss@h/db'], body) == 2
    assert capsys.readouterr().err == "try: error: storage 'postgresql://u:***@h/db': no answer\n"


def test_arguments_of_ros_are_accepted():
    """As a launch file gives them to every program."""
    parser = argparse.ArgumentParser(prog='try')
    parser.add_argument('--number', type=int)
    seen = []
    words = ['--ros-args', '-r', '__node:=x', '--params-file', 'f', '--', '--number', '3']
    assert run_command(parser, words, lambda a, _: seen.append((a.number, a.ros_arguments))) == 0
    assert run_command(parser, words[:5], lambda a, _: seen.append((a.number, [])) or 0) == 0
    assert seen == [(3, ['-r', '__node:=x', '--params-file', 'f']), (None, [])]


def test_progress_is_a_line_now_and_then_where_there_is_no_terminal(capsys, monkeypatch):
    with progress(total=2, desc='short') as bar:
        bar.update(2)
    assert capsys.readouterr().err == ''
    monkeypatch.setattr('fhaosmo_ros.tools.cli.progress.PERIOD', 0.01)
    with progress(total=3, desc='long') as bar:
        for _ in range(3):
            time.sleep(0.02)
            bar.update()
    said = capsys.readouterr().err
    assert '\r' not in said
    assert 2 <= len(said.splitlines()) <= 4
    assert all(line.startswith('long: ') for line in said.splitlines())


def test_missing_modules_are_named_before_the_body_begins(capsys):
    needs = ('no_such_module>=4,<6', 'numpy', 'nor_this')
    assert run_command(PARSER, [], lambda *_: pytest.fail('began'), needs=needs) == 1
    said = capsys.readouterr().err
    assert said.startswith('try: error: no_such_module and nor_this not installed: make try')
    assert said.endswith("pip install 'no_such_module>=4,<6' numpy nor_this\n")


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_signal_cuts_a_computation(capsys, number):
    def body(arguments, stop):
        with stop.raising():
            signal.raise_signal(number)
            pytest.fail('went on')

    assert run_command(PARSER, [], body) == 130
    assert capsys.readouterr().err == 'try: interrupted\n'


def test_output_replaces_only_what_is_empty_or_forced(tmp_path):
    final = tmp_path / 'out'
    final.mkdir()
    for force, text in ((False, 'new'), (True, 'newer')):
        with Output(final, force) as output:
            output.path.mkdir()
            (output.path / 'file').write_text(text)
            assert output.keep() == final
    assert (final / 'file').read_text() == 'newer'
    with pytest.raises(ConfigurationError, match='--force'), Output(final):
        pass
    assert [p.name for p in tmp_path.iterdir()] == ['out']


def test_what_is_there_stays_until_the_new_output_is_complete(tmp_path):
    (tmp_path / 'out').write_text('old')
    with Output(tmp_path / 'out', force=True) as output:
        output.path.write_text('half')
    assert (tmp_path / 'out').read_text() == 'old'
    assert [p.name for p in tmp_path.iterdir()] == ['out']


def disposition(ignored: bool) -> None:
    """Set what a child does at SIGINT; and at SIGHUP, which these tests under nohup ignore."""
    signal.signal(signal.SIGINT, signal.SIG_IGN if ignored else signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.fixture
def busy(tmp_path):
    """Return a function that starts a command with two workers, and waits until they work."""
    (tmp_path / 'busy.py').write_text(BUSY)
    started = []

    def start(ignored: bool) -> tuple[subprocess.Popen, list[int]]:
        process = subprocess.Popen(
            [sys.executable, tmp_path / 'busy.py', tmp_path],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            preexec_fn=lambda: disposition(ignored),
            env={**os.environ, 'PYTHONPATH': os.pathsep.join([str(ROOT), *sys.path])},
        )
        started.append(process)
        deadline = time.monotonic() + 90
        while len(pids := [p.read_text() for p in tmp_path.glob('*.pid')]) < 2 or not all(pids):
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < deadline
            time.sleep(0.02)
        return process, [int(pid) for pid in pids]

    yield start
    for process in started:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()


def wait_for_end(pids: list[int]) -> None:
    deadline = time.monotonic() + 20
    while any(Path(f'/proc/{pid}').exists() for pid in pids):
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.signals
@pytest.mark.parametrize(
    ('number', 'ignored', 'group'),
    [
        (signal.SIGINT, False, True),  # Ctrl-C in a terminal
        (signal.SIGINT, True, False),  # kill -INT of a script's background job
        (signal.SIGTERM, False, False),
        (signal.SIGTERM, True, True),  # timeout(1)
        (signal.SIGHUP, False, True),  # the terminal or the SSH connection closes
    ],
)
def test_signal_ends_command_and_workers(busy, tmp_path, number, ignored, group):
    process, pids = busy(ignored)
    (os.killpg if group else os.kill)(process.pid, number)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 130
    assert (out, err) == ('', 'busy: interrupted\n')
    wait_for_end(pids)
    assert {p.name for p in tmp_path.iterdir()} == {'busy.py', '0.pid', '1.pid'}


@pytest.mark.signals
def test_workers_end_when_their_parent_is_killed(busy):
    process, pids = busy(False)
    process.kill()
    process.communicate()
    wait_for_end(pids)


@pytest.mark.signals
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signal_ends_a_command_that_still_loads(tmp_path, number):
    (tmp_path / 'slow.py').write_text('import time\nprint("loads", flush=True)\ntime.sleep(600)\n')
    script = (
        'from fhaosmo_ros.__main__ import COMMANDS, main\n'
        "COMMANDS['slow'] = ('slow', '')\n"
        "raise SystemExit(main(['slow']))\n"
    )
    process = subprocess.Popen(
        [sys.executable, '-c', script],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: disposition(True),
        env={**os.environ, 'PYTHONPATH': os.pathsep.join([str(tmp_path), str(ROOT), *sys.path])},
    )
    with process:
        assert process.stdout.readline() == 'loads\n'
        process.send_signal(number)
        try:
            assert process.wait(10) == 130
        finally:
            process.kill()
        assert process.stderr.read() == ''


NOHUP = """
import signal
from fhaosmo_ros.stop_signals import stop_on_signals
signal.signal(signal.SIGHUP, signal.SIG_IGN)
stop = stop_on_signals()
signal.raise_signal(signal.SIGHUP)
assert not stop.is_set()
"""


@pytest.mark.signals
def test_what_nohup_started_goes_on():
    subprocess.run([sys.executable, '-c', NOHUP], check=True, cwd=ROOT)
