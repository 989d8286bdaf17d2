# SPDX-License-Identifier: Apache-2.0
"""A document whose generated parts stand between markers."""

from collections.abc import Mapping
from pathlib import Path
import re

from fhaosmo_ros.core.errors import ConfigurationError

PART = '<!-- begin {0} -->\n{1}\n<!-- end {0} -->'
PATTERN = re.compile(r'<!-- begin (?P<name>\S+) -->\n(?P<text>.*?)\n?<!-- end (?P=name) -->', re.S)


def parts(document: str) -> dict[str, str]:
    """Return the generated parts of a document by name."""
    return {match['name']: match['text'] for match in PATTERN.finditer(document)}


def filled(document: str, texts: Mapping[str, str]) -> str:
    """
    Return the document with its parts replaced.

    Raises
    ------
    ConfigurationError
        The document's markers and `texts` do not have the same names.

    """
    present = set(parts(document))
    if present != set(texts):
        raise ConfigurationError(
            f'markers of the document: expected {", ".join(sorted(texts))}, '
            f'got {", ".join(sorted(present))}'
        )
    return PATTERN.sub(lambda match: PART.format(match['name'], texts[match['name']]), document)


def write(path: Path, texts: Mapping[str, str], title: str = 'The paper, reproduced') -> None:
    """Rewrite the generated parts of the document at `path`, or write them alone if it is new."""
    if path.exists():
        text = filled(path.read_text(encoding='utf-8'), texts)
    else:
        bodies = (f'## {name}\n\n{PART.format(name, body)}\n' for name, body in texts.items())
        text = f'# {title}\n\n' + '\n'.join(bodies)
    path.write_text(text, encoding='utf-8')
