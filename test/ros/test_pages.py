# SPDX-License-Identifier: Apache-2.0
"""The commands of the first pages do as they are written there, one after the other."""

import re
import signal
import subprocess

from commands import start
import numpy as np
from running import DEADLINE, ROOT
from waiting import wait_until

PAGES = {name: (ROOT / name).read_text() for name in ('README.md', 'docs/start.md')}
COMMAND = re.compile(r'^ +ros2 run fhaosmo_ros ((?:record|replay|plot) .*?)(?: +#.*)?$', re.M)
FIRST_SAMPLES = 200_000
"""Bytes of a bag with the first second of plant and estimator."""


def test_commands_of_the_first_pages_run_one_after_the_other(launch, tmp_path):
    commands = COMMAND.findall(PAGES['docs/start.md'])
    assert set(COMMAND.findall(PAGES['README.md'])) <= set(commands)
    text = re.search(r'^```yaml\n(.*?)```', PAGES['docs/start.md'], re.M | re.S)[1]
    (tmp_path / 'pendulum.yaml').write_text(text)
    t = np.arange(0.0, 2.0, 1e-3)
    table = np.column_stack([t, 0.5 * np.cos(4.4 * t), np.zeros_like(t)])
    np.savetxt(tmp_path / 'my.csv', table, delimiter=',', header='t,angle,tau', comments='')
    bag = tmp_path / 'run/run_0.mcap'

    def recorded():
        return bag.exists() and bag.stat().st_size > FIRST_SAMPLES

    launch('plant')
    launch('estimator')
    assert commands[0].startswith('record')
    for command in commands:
        with start(*command.split(), stderr=subprocess.STDOUT, cwd=tmp_path) as process:
            if command.startswith('record'):
                wait_until(recorded, 'samples in the bag', process=process)
                process.send_signal(signal.SIGINT)
            output, _ = process.communicate(timeout=DEADLINE)
        assert process.returncode == 0, f'{command}: {output}'
        made = re.search(r' -o (\S+)', command)[1]
        assert (tmp_path / made).exists(), command
