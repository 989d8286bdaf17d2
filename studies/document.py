# SPDX-License-Identifier: Apache-2.0
"""A document whose generated parts stand between markers, and the folder of its figures."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
import json
from pathlib import Path
import re
from typing import Any, NamedTuple

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.tools.cli.output import Output

PART = '<!-- begin {0} -->\n{1}\n<!-- end {0} -->'
PATTERN = re.compile(r'<!-- begin (?P<name>\S+) -->\n(?P<text>.*?)\n?<!-- end (?P=name) -->', re.S)


def parts(document: str) -> dict[str, str]:
    """Return the generated parts of a document by name."""
    return {match['name']: match['text'] for match in PATTERN.finditer(document)}


def filled(document: str, texts: Mapping[str, str]) -> str:
    """
    Return the document with these parts replaced; others stay.

    Raises
    ------
    ConfigurationError
        The document has no markers of one of the names.

    """
    present = set(parts(document))
    if not set(texts) <= present:
        raise ConfigurationError(
            f'markers of the document: expected {", ".join(sorted(texts))}, '
            f'got {", ".join(sorted(present)) or "none"}'
        )
    return PATTERN.sub(
        lambda match: PART.format(match['name'], texts.get(match['name'], match['text'])), document
    )


def refill(
    page: Path, texts: Mapping[str, str], figure: Any = None, results: Any = None, name: str = ''
) -> list[Path]:
    """
    Fill the generated parts of a page that is there, and write what belongs to it beside it.

    Parameters
    ----------
    page : path
    texts : mapping
        Generated parts by name.
    figure : Figure, optional
        Written as `name`.png.
    results : optional
        What JSON can hold; written as `name`.json.
    name : str
        Default: that of the page.

    Returns
    -------
    list of path
        What was written.

    """
    beside = page.with_stem(name or page.stem)
    text = filled(page.read_text(encoding='utf-8'), texts)
    made = []
    if results is not None:
        with Output(beside.with_suffix('.json'), force=True) as output:
            output.path.write_text(json.dumps(results, indent=1) + '\n', encoding='utf-8')
            made.append(output.keep())
    if figure is not None:
        with Output(beside.with_suffix('.png'), force=True) as output:
            figure.savefig(output.path, dpi=110)
            made.append(output.keep())
    with Output(page, force=True) as output:
        output.path.write_text(text, encoding='utf-8')
        made.append(output.keep())
    return made


class Pages(NamedTuple):
    """
    A document and its folder while they are made.

    Attributes
    ----------
    folder : path
        For figures and results; exists.
    write : callable
        Takes the generated parts by name and writes the document.

    """

    folder: Path
    write: Callable[[Mapping[str, str]], None]


@contextmanager
def rewriting(output: Path, name: str, title: str) -> Iterator[Pages]:
    """
    Replace the document `name`.md and the folder `name` of `output` at the end of the block.

    An exception, or a signal that raises one, leaves both as they were. The text between the
    generated parts of a document stays; a new document gets the title and the parts alone.

    Raises
    ------
    ConfigurationError
        A place that can't be written, or a document with other parts.

    """
    made_here = not output.exists()
    path = output / f'{name}.md'
    try:
        with Output(output / name, force=True) as folder, Output(path, force=True) as document:

            def write(texts: Mapping[str, str]) -> None:
                document.path.write_text(_text(path, texts, title), encoding='utf-8')

            folder.path.mkdir()
            yield Pages(folder.path, write)
            folder.keep()
            document.keep()
    finally:
        if made_here:
            with suppress(OSError):  # it is not empty, or was never made
                output.rmdir()


def _text(path: Path, texts: Mapping[str, str], title: str) -> str:
    if path.exists():
        return filled(path.read_text(encoding='utf-8'), texts)
    bodies = (f'## {name}\n\n{PART.format(name, body)}\n' for name, body in texts.items())
    return f'# {title}\n\n' + '\n'.join(bodies)
