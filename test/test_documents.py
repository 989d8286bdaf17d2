# SPDX-License-Identifier: Apache-2.0
"""What the documents and the shipped configurations say is what the code does."""

from pathlib import Path
import re
import subprocess
import sys

from fhaosmo_ros.core import Observer, Plant
from fhaosmo_ros.core.compiled.cache import cache_folder
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import NODE_TABLES, OBSERVER_PARAMETERS, PLANT_PARAMETERS
import pytest
from studies.parameter_reference import markdown
import yaml

ROOT = Path(__file__).resolve().parents[1]
CONFIGURATIONS = sorted((ROOT / 'config').glob('**/*.yaml'))


def test_parameter_table_is_up_to_date():
    text = (ROOT / 'docs' / 'parameters.md').read_text(encoding='utf-8')
    assert text == markdown(), 'run python -m studies.parameter_reference'
    for table in NODE_TABLES.values():
        assert [name for name in table if f'| `{name}` |' not in text] == []


@pytest.mark.parametrize('path', CONFIGURATIONS, ids=lambda p: p.stem)
def test_every_key_of_a_shipped_configuration_is_declared_and_used(path):
    estimator, plant = load(path, 'estimator'), load(path, 'plant')
    sections = yaml.safe_load(path.read_text())['/**']['ros__parameters']
    keys = {
        name
        for key, value in sections.items()
        for name in ([f'{key}.{k}' for k in value] if isinstance(value, dict) else [key])
    }
    assert keys == set(estimator) | set(plant)
    Observer({k: v for k, v in estimator.items() if k in OBSERVER_PARAMETERS})
    Plant({k: v for k, v in plant.items() if k in PLANT_PARAMETERS})


def test_paper_configuration_has_the_papers_numbers():
    estimator = load(ROOT / 'config' / 'paper.yaml', 'estimator')
    assert estimator['lambda'] == [15.0] * 4
    assert estimator['alpha'] == [30.0] * 4
    assert estimator['epsilon'] == 0.025
    assert (estimator['gamma_rate'], estimator['gamma_initial']) == (0.004, 0.5)
    assert load(ROOT / 'config' / 'paper.yaml', 'plant')['disturbance_amplitude'] == 0.1


def test_library_example_of_the_readme_runs(tmp_path):
    blocks = re.findall(r'```python\n(.*?)```', (ROOT / 'README.md').read_text(), re.DOTALL)
    assert blocks, 'the README has lost its example'
    for block in blocks:
        script = tmp_path / 'example.py'
        script.write_text(block)
        result = subprocess.run(
            [sys.executable, script], capture_output=True, text=True, cwd=ROOT,
            env={
                'PATH': '/usr/bin:/bin', 'PYTHONPATH': str(ROOT), 'HOME': str(tmp_path),
                'XDG_CACHE_HOME': str(cache_folder().parents[1]),  # it need not compile again
            },
            check=False,
        )  # fmt: skip
        assert result.returncode == 0, result.stderr
        assert result.stdout.strip()


def test_links_of_the_documents_lead_somewhere():
    for document in [ROOT / 'README.md', *(ROOT / 'docs').glob('*.md')]:
        for target in re.findall(r'\]\(([^)#:]+)\)', document.read_text(encoding='utf-8')):
            assert (document.parent / target).exists(), f'{document.name}: {target}'
