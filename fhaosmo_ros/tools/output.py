# SPDX-License-Identifier: Apache-2.0
"""Output that is complete or absent."""

from pathlib import Path
import shutil
from types import TracebackType

from fhaosmo_ros.core.errors import ConfigurationError


class OutputFolder:
    """
    A folder that is filled under another name and gets its own once it is complete.

    Parameters
    ----------
    final : path
        Must be absent or empty.

    Attributes
    ----------
    path : path
        Where to write meanwhile.

    Raises
    ------
    ConfigurationError
        The folder is in use or can't be made.

    """

    def __init__(self, final: Path) -> None:
        self._final = final
        self.path = final.with_name(f'.{final.name}.part')

    def __enter__(self) -> 'OutputFolder':
        final = self._final
        if final.exists() and (not final.is_dir() or any(final.iterdir())):
            kind = 'a folder that is not empty' if final.is_dir() else 'a file'
            raise ConfigurationError(f'output {final}: expected a new or empty folder, got {kind}')
        try:
            shutil.rmtree(self.path, ignore_errors=True)  # of a run that was killed
            self.path.mkdir(parents=True)
        except OSError as error:
            raise ConfigurationError(
                f'output {final}: expected a folder that can be made, got: {error.strerror}'
            ) from None
        return self

    def keep(self) -> Path:
        """Give the folder its final name and return it."""
        if self._final.exists():
            self._final.rmdir()
        return self.path.rename(self._final)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        shutil.rmtree(self.path, ignore_errors=True)


class Output:
    """
    A file or folder that is made in a hidden folder beside its place, and moved once complete.

    Parameters
    ----------
    final : path
        Must be absent, unless `force`; what is there stays until the new one is complete.

    Attributes
    ----------
    path : path
        Where to write meanwhile; has the final name, and does not exist yet.

    Raises
    ------
    ConfigurationError
        The path is in use or can't be made.

    """

    def __init__(self, final: Path, force: bool = False) -> None:
        self._final, self._force = final, force
        self._folder = final.with_name(f'.{final.name}.part')
        self.path = self._folder / final.name

    def __enter__(self) -> 'Output':
        if self._final.exists() and not self._force:
            kind = 'folder' if self._final.is_dir() else 'file'
            raise ConfigurationError(
                f'output {self._final}: expected a new name (or --force to replace it), '
                f'got an existing {kind}'
            )
        try:
            shutil.rmtree(self._folder, ignore_errors=True)  # of a run that was killed
            self._folder.mkdir(parents=True)
        except OSError as error:
            raise ConfigurationError(
                f'output {self._final}: expected a place that can be written, '
                f'got: {error.strerror}'
            ) from None
        return self

    def keep(self) -> Path:
        """Give it its final name and return that."""
        if self._final.exists():
            self._final.rename(self._folder / 'replaced')
        return self.path.rename(self._final)

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)
