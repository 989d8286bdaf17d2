# SPDX-License-Identifier: Apache-2.0
"""Output that is complete or absent."""

from pathlib import Path
import shutil

from fhaosmo_ros.core.parameters.errors import ConfigurationError


def named(path: Path) -> Path:
    """
    Return a path to write to.

    Raises
    ------
    ConfigurationError
        It has no name of its own that something could be renamed to: ``.``, ``..`` or ``/``.

    """
    if path.name in ('', '..'):
        raise ConfigurationError(f'output {path}: expected a name, got a folder that is in use')
    return path


class Output:
    """
    A file or folder that is made in a hidden folder beside its place, and moved once complete.

    Parameters
    ----------
    final : path
        Must be absent or an empty folder, unless `force`. What is there stays until the new one
        is complete.
    force : bool
        Replace what is there.

    Attributes
    ----------
    path : path
        Where to write meanwhile: has the final name, and does not exist yet; its folder does.

    Raises
    ------
    ConfigurationError
        The path is in use, or it cannot be made.

    """

    def __init__(self, final: Path, force: bool = False) -> None:
        self._final, self._force = named(final), force
        self._folder = final.with_name(f'.{final.name}.part')
        self.path = self._folder / final.name

    def __enter__(self) -> 'Output':
        final = self._final
        try:
            if not self._force and final.exists():
                _expect_empty_folder(final)
            shutil.rmtree(self._folder, ignore_errors=True)  # of a run that was killed
            self._folder.mkdir(parents=True)
        except OSError as error:
            raise ConfigurationError(
                f'output {final}: expected a place that can be written, got: {error.strerror}'
            ) from None
        return self

    def keep(self) -> Path:
        """Give it its final name and return that."""
        if self._final.exists():
            self._final.rename(self._folder / 'replaced')
        return self.path.rename(self._final)

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)


def _expect_empty_folder(path: Path) -> None:
    if not path.is_dir() or any(path.iterdir()):
        kind = 'folder with something in it' if path.is_dir() else 'file'
        raise ConfigurationError(
            f'output {path}: expected a new name (or --force to replace it), got an existing '
            f'{kind}'
        )
