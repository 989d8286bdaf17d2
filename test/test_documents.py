# SPDX-License-Identifier: Apache-2.0
"""Pages and shipped configurations: what they show is accepted, and tables are the code's."""

import contextlib
from pathlib import Path
import re
import subprocess
import sys

from fhaosmo_ros import topics
from fhaosmo_ros.__main__ import main
from fhaosmo_ros.commands import COMMANDS
from fhaosmo_ros.core import Counters, Observer, OnlineEstimator, Plant
from fhaosmo_ros.core.parameters import tables
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.tools.tuning.objective import TUNE_PARAMETERS
import numpy as np
import pytest
from studies.parameter_reference import markdown
import yaml

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = 'fhaosmo_ros'
CONFIGURATIONS = sorted((ROOT / 'config').glob('**/*.yaml'))
PAGES = {
    path.name: path.read_text(encoding='utf-8')
    for path in [ROOT / 'README.md', *sorted((ROOT / 'docs').glob('*.md'))]
}
NODE = PAGES['node.md']
TABLES = tables.NODE_TABLES | {'tune': TUNE_PARAMETERS}


def blocks(page, language):
    return re.findall(rf'```{language}\n(.*?)```', PAGES[page], re.S)


def cells(text):
    """Return the cells of each row of the tables in a text, titles included."""
    rows = [line.strip('|').split(' | ') for line in text.splitlines() if line.startswith('| ')]
    return [[cell.strip() for cell in row] for row in rows]


def names(text):
    return re.findall(r'`~?/?([a-z_0-9]+)`', text)


def test_parameter_table_is_up_to_date():
    assert PAGES['parameters.md'] == markdown(), 'run python -m studies.parameter_reference'
    for table in tables.NODE_TABLES.values():
        assert [name for name in table if f'| `{name}` |' not in PAGES['parameters.md']] == []


@pytest.mark.parametrize('path', CONFIGURATIONS, ids=lambda p: p.stem)
def test_every_key_of_a_shipped_configuration_is_declared_and_used(path):
    estimator, plant, arm = (load(path, node) for node in ('estimator', 'plant', 'arm'))
    sections = yaml.safe_load(path.read_text())['/**']['ros__parameters']
    keys = {
        name
        for key, value in sections.items()
        for name in ([f'{key}.{k}' for k in value] if isinstance(value, dict) else [key])
    }
    assert keys in (set(estimator) | set(plant), set(arm))
    Observer({k: v for k, v in estimator.items() if k in tables.OBSERVER_PARAMETERS})
    Plant({k: v for k, v in plant.items() if k in tables.PLANT_PARAMETERS})


def test_topics_in_the_table_are_those_of_the_code():
    texts = NODE.split('## Topics')[1].split('## ')[0].split('Of the plant:')
    written = {
        (node, name): kind
        for node, table in zip(('estimator', 'plant'), texts, strict=True)
        for row in cells(table)
        for name in names(row[0])
        for kind in row[1].split(', ')
        if not row[0].startswith('in:') and 'srvs' not in kind
    }
    said = topics.DIAGNOSTICS
    latched = {topics.EVENT: said, topics.PARAMETERS: topics.TEXT, topics.SNAPSHOT: topics.ARRAY}
    declared = topics.ESTIMATES | topics.TYPED_ESTIMATES | latched
    for of_gains in topics.OF_GAINS.values():
        declared |= of_gains
    expected = {('estimator', name): kind for name, kind in declared.items()}
    expected |= {('estimator', 'diagnostics'): said, ('plant', 'y'): topics.FLOAT}
    expected |= {('plant', name): kind for name, kind in topics.TRUTH.items()}
    del written[('estimator', 'change_state')]
    assert written == {key: kind.replace('/msg/', '/') for key, kind in expected.items()}


def test_counters_in_the_tables_are_those_of_the_code():
    text = NODE.split('## Time')[1].split('## Faults')[0]
    parts = [part for part in text.split('\n\n') if '| counter |' in part]
    written = [name for part in parts for row in cells(part)[1:] for name in names(row[-1])]
    assert set(written) == set(Counters._fields)


@pytest.mark.parametrize('page', [page for page in PAGES if blocks(page, 'yaml')])
def test_yaml_is_accepted(page, tmp_path):
    for text in blocks(page, 'yaml'):
        path = tmp_path / 'block.yaml'
        path.write_text(text)
        for node, table in TABLES.items():
            load(path, node, table)
        channels = load(path, 'estimator').get('channels', [''])
        for channel in channels:
            OnlineEstimator.from_yaml(path, channel=channel)


def commands():
    """Return (page, words) of each command of this package in the pages."""
    found = []
    for page, text in PAGES.items():
        joined = text.replace('\\\n', ' ')
        shown = re.findall(r'^(?: {4}| {6})(\S.*)$', joined, re.M)
        shown += re.findall(r'`([^`]+)`', joined)
        for line in shown:
            for words in re.findall(r'(?:ros2 \w+|-m|fhaosmo) [^#&]+', line):
                found.append((page, words.split()))
    return found


def own_command(words):
    """Return name and arguments of a command of this package; ('', []) of another one."""
    if words[:3] == ['ros2', 'run', PACKAGE] or words[:2] == ['-m', PACKAGE]:
        words = words[words.index(PACKAGE) :]
    elif words[0] != 'fhaosmo':
        return '', []
    _, name, *rest = [*words, ''] if len(words) == 1 else words
    return (name, rest) if re.fullmatch(r'[a-z]+', name) else ('', [])  # X, an option, or dots


def test_commands_exist_with_their_options(capsys):
    helps = {}
    for page, words in commands():
        name, rest = own_command(words)
        if not name:
            continue
        assert name in COMMANDS, page
        module = COMMANDS[name][0]
        if name not in helps and not module.startswith('fhaosmo_ros.nodes'):
            with contextlib.suppress(SystemExit):
                main([name, '--help'])
            helps[name] = capsys.readouterr().out
        options = [word for word in rest if re.fullmatch(r'--?[a-z][a-z-]*', word)]
        if helps.get(name):  # without ROS some have none
            assert [word for word in options if word not in helps[name]] == [], (page, words)


def test_parameters_and_files_of_commands_exist():
    declared = {name for table in TABLES.values() for name in table} | {'use_sim_time'}
    makefile = (ROOT / 'Makefile').read_text()
    for page, words in commands():
        line = ' '.join(words)
        assert set(re.findall(r'-p [\'"]?([a-z_]+):=', line)) <= declared, (page, line)
        if words[:3] == ['ros2', 'param', 'set'] and len(words) > 5:
            table, name = TABLES[words[3].strip('/')], words[4]
            value = yaml.safe_load(' '.join(words[5:]).strip('"'))
            if not name.startswith(('constants.', 'hip.')):
                table[name].coerce(value)
        if words[:3] == ['ros2', 'launch', PACKAGE]:
            files = ROOT / 'launch' / words[3], ROOT / PACKAGE / 'launching.py'
            text = ''.join(path.read_text() for path in files)
            names = [word.split(':=')[0] for word in words[4:] if ':=' in word]
            assert [name for name in names if f"'{name}'" not in text] == [], (page, line)
        for path in re.findall(r'\bconfig/[\w./-]+\.(?:yaml|xml|json)', line):
            assert (ROOT / path).exists(), (page, line)
    for page, text in PAGES.items():
        for target in re.findall(r'(?:^ {4}|`)make ([a-z]+)', text, re.M):
            assert f'\n{target}:' in makefile, f'{page}: make {target}'


@pytest.mark.parametrize('page', ['README.md', 'start.md', 'offline.md'])
def test_python_runs(page, tmp_path):
    """With the file and the recording that start.md speaks of at hand."""
    for text in blocks('start.md', 'yaml'):
        (tmp_path / 'pendulum.yaml').write_text(text)
    t = np.arange(0.0, 2.0, 1e-3)
    table = np.column_stack([t, 0.5 * np.cos(4.4 * t), np.zeros_like(t)])
    np.savetxt(tmp_path / 'my.csv', table, delimiter=',', header='t,y,u')
    for text in blocks(page, 'python'):
        script = tmp_path / 'example.py'
        script.write_text(text)
        result = subprocess.run(
            [sys.executable, script], capture_output=True, text=True, cwd=tmp_path,
            env={'PATH': '/usr/bin:/bin', 'PYTHONPATH': str(ROOT), 'HOME': str(tmp_path)},
            check=False,
        )  # fmt: skip
        assert result.returncode == 0, result.stderr


def test_links_and_paths_of_the_documents_lead_somewhere():
    for name, text in PAGES.items():
        folder = ROOT if name == 'README.md' else ROOT / 'docs'
        for target in re.findall(r'\]\(([^)#:]+)(?:#[^)]*)?\)', text):
            assert (folder / target).exists(), f'{name}: {target}'
    bases = [ROOT / base for base in ('', PACKAGE, f'{PACKAGE}/core')]
    for path in re.findall(r'`([\w./]+(?:\.(?:py|pyx|pxd|xml)|/))`', PAGES['inside.md']):
        assert any((base / path).exists() for base in bases), path
