# SPDX-License-Identifier: Apache-2.0
"""Pages and shipped configurations: what they show is accepted, runs, and leads somewhere."""

import contextlib
import re
import sys

from commands import ROOT, run
from fhaosmo_ros import topics
from fhaosmo_ros.__main__ import main
from fhaosmo_ros.commands import COMMANDS
from fhaosmo_ros.core import Counters, Observer, OnlineEstimator, Plant
from fhaosmo_ros.core.parameters import tables
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.tools.tuning.tuner import TUNE_PARAMETERS
import numpy as np
import pytest
import results
from studies import comparison, everywhere, evidence, paper
from studies.parameter_reference import markdown
import yaml

PACKAGE = 'fhaosmo_ros'
CONFIGURATIONS = sorted((ROOT / 'config').glob('**/*.yaml'))
PAGES = {
    path.name: path.read_text(encoding='utf-8')
    for path in [ROOT / 'README.md', *sorted((ROOT / 'docs').glob('*.md'))]
}
TABLES = tables.NODE_TABLES | {'tune': TUNE_PARAMETERS}


def blocks(page, language):
    return re.findall(rf'```{language}\n(.*?)```', PAGES[page], re.S)


def test_tables_have_all_parameters_topics_and_counters():
    assert PAGES['parameters.md'] == markdown(), 'run python -m studies.parameter_reference'
    names = [*topics.ESTIMATES, *topics.TYPED_ESTIMATES, *topics.TRUTH, *Counters._fields]
    for name in [*names, *(name for of_gains in topics.OF_GAINS.values() for name in of_gains)]:
        assert re.search(rf'`(~/)?{name}`', PAGES['node.md']), name


@pytest.mark.parametrize('path', CONFIGURATIONS, ids=lambda p: p.stem)
def test_every_key_of_a_shipped_configuration_is_declared_and_used(path):
    estimator, plant, arm = (load(path, node) for node in ('estimator', 'plant', 'arm'))
    keys = set(yaml.safe_load(path.read_text())['/**']['ros__parameters'])
    own = {name.split('.')[0] for name in estimator | plant}  # of one name: constants.k
    assert keys in (own, set(arm))
    Observer({k: v for k, v in estimator.items() if k in tables.OBSERVER_PARAMETERS})
    Plant({k: v for k, v in plant.items() if k in tables.PLANT_PARAMETERS})


@pytest.mark.parametrize('page', [page for page in PAGES if blocks(page, 'yaml')])
def test_yaml_is_accepted(page, tmp_path):
    path = tmp_path / 'block.yaml'
    for text in blocks(page, 'yaml'):
        path.write_text(text)
        for node, table in TABLES.items():
            load(path, node, table)
        for channel in load(path, 'estimator').get('channels', ['']):
            OnlineEstimator.from_yaml(path, channel=channel)


def test_commands_options_parameters_and_files_exist(capsys):
    declared = {name for table in TABLES.values() for name in table} | {'use_sim_time'}
    for page, text in PAGES.items():
        joined = text.replace('\\\n', ' ')
        shown = re.findall(r'^ {4,6}(\S.*)$', joined, re.M) + re.findall(r'`([^`]+)`', joined)
        for line in shown:
            assert set(re.findall(r'-p [\'"]?([a-z_]+):=', line)) <= declared, (page, line)
            for path in re.findall(r'\bconfig/[\w./-]+\.(?:yaml|xml|json)', line):
                assert (ROOT / path).exists(), (page, line)
            own = rf'(?:ros2 run {PACKAGE}|-m {PACKAGE}|fhaosmo) ([a-z]+)(?= |$)([^#&]*)'
            for name, options in re.findall(own, line):
                assert name in COMMANDS, (page, line)
                if not COMMANDS[name][0].startswith('.nodes'):
                    with contextlib.suppress(SystemExit):
                        main([name, '--help'])
                    told = capsys.readouterr().out  # nothing by some of them without ROS
                    options = re.findall(r' (--?[a-z][a-z-]*)', options)
                    assert not told or all(option in told for option in options), (page, line)


@pytest.mark.parametrize('page', ['README.md', 'start.md', 'offline.md'])
def test_python_runs(page, tmp_path):
    """With the file and the recording that start.md speaks of at hand."""
    for text in blocks('start.md', 'yaml'):
        (tmp_path / 'pendulum.yaml').write_text(text)
    t = np.arange(0.0, 2.0, 1e-3)
    table = np.column_stack([t, 0.5 * np.cos(4.4 * t), np.zeros_like(t)])
    np.savetxt(tmp_path / 'my.csv', table, delimiter=',', header='t,y,u')
    for text in blocks(page, 'python'):
        run('-c', text, command=[sys.executable], cwd=tmp_path).check_returncode()


def test_links_paths_and_targets_of_the_documents_lead_somewhere():
    makefile = (ROOT / 'Makefile').read_text()
    for name, text in PAGES.items():
        folder = ROOT if name == 'README.md' else ROOT / 'docs'
        for target in re.findall(r'\]\(([^)#:]+)(?:#[^)]*)?\)', text):
            assert (folder / target).exists(), f'{name}: {target}'
        for target in re.findall(r'(?:^ {4}|`)make ([a-z]+)', text, re.M):
            assert f'\n{target}:' in makefile, f'{name}: make {target}'
    bases = [ROOT / base for base in ('', PACKAGE, f'{PACKAGE}/core')]
    for path in re.findall(r'`([\w./]+(?:\.(?:py|pyx|pxd|xml)|/))`', PAGES['inside.md']):
        assert any((base / path).exists() for base in bases), path


RECIPES = sorted((ROOT / 'config' / 'recipes').glob('*.yaml'))


@pytest.mark.parametrize('path', RECIPES, ids=lambda p: p.stem)
def test_recipe_runs_as_the_node_would_run_it(path):
    """On a sine: what it estimates is not the point, but that it takes the samples."""
    channel = load(path, 'estimator').get('channels', [''])[0]
    estimator = OnlineEstimator.from_yaml(path, channel=channel)
    stamps = 10**9 + np.arange(1000) * 5_000_000
    noise = 1e-3 * np.random.default_rng(0).standard_normal(1000)
    u = np.full((1000, len(estimator.inputs)), 0.1)
    found = estimator.run(stamps, 0.1 * np.sin(stamps * 2e-9) + noise, u)
    assert np.isfinite(found.z).all()
    assert estimator.counters.accepted >= 990


PUBLISHED = {'/y'}
for node, published in (
    ('estimator', topics.estimates_of({'gains': 'fixed'})), ('plant', topics.TRUTH),
    ('joint_estimator', topics.TYPED_ESTIMATES),
):  # fmt: skip
    PUBLISHED |= {f'/{node}/{name}' for name in published}


@pytest.mark.parametrize('path', [*(ROOT / 'config/layouts').iterdir()], ids=lambda p: p.name)
def test_layouts_of_plotjuggler_and_foxglove_show_what_is_published(path):
    shown = re.findall(r'"(/[\w/]+)', path.read_text())
    assert shown
    for name in shown:
        assert any(f'{name}/'.startswith(f'{topic}/') for topic in PUBLISHED), name


def test_site_builds_without_a_warning(tmp_path):
    """Sphinx warns of links, to pages and to places in them, that lead nowhere."""
    pytest.importorskip('myst_parser', reason='sphinx is not installed: extra docs')
    options = ['-W', '--keep-going', '-q', '-d', tmp_path / 'made']
    sphinx = [sys.executable, '-m', 'sphinx']
    done = run(*options, ROOT / 'docs', tmp_path / 'site', command=sphinx)
    assert done.returncode == 0, done.stderr
    assert 'Observer.smooth' in (tmp_path / 'site' / 'offline.html').read_text()


# docs/evidence.md says what its tables say, and these have the paper's findings.
MAKERS = {
    'speed': results, 'comparison': comparison, 'everywhere': everywhere, 'paper': paper,
}  # fmt: skip


@pytest.mark.parametrize('name', MAKERS)
def test_the_page_says_what_the_table_says(name):
    shown = evidence.parts((evidence.DOCS / evidence.PAGE).read_text(encoding='utf-8'))
    texts = MAKERS[name].texts(evidence.read(name))
    assert {part: shown[part] for part in texts} == texts


def test_best_solver_and_all_findings_come_out():
    rows = evidence.read('paper')
    documented = {of: paper.scores_of(rows, of) for of in (paper.SOLVER, *paper.EARLIER)}

    def error(solver):
        return sum(documented[solver][paper.FINE, w]['rms_d'] for w in paper.FREQUENCIES)

    *_, held = paper.EARLIER
    assert min(set(documented) - {held}, key=error) == paper.SOLVER
    assert all(v.holds for v in paper.verdicts(documented[paper.SOLVER]))
