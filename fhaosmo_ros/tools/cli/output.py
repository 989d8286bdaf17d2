# SPDX-License-Identifier: Apache-2.0
"""Output that is complete or absent."""

from pathlib import Path
import shutil

from fhaosmo_ros.core.parameters.errors import ConfigurationError


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
        if final.name in ('', '..'):  # nothing could be renamed to it
            raise ConfigurationError(
                f'output {final}: expected a name, got a folder that is in use'
            )
        self._final, self._force = final, force
        self._folder = final.with_name(f'.{final.name}.part')
        self.path = self._folder / final.name

    def __enter__(self) -> 'Output':
        final = self._final
        try:
            if not self._force and final.exists():
                folder = final.is_dir()
                if not folder or any(final.iterdir()):
                    raise ConfigurationError(
                        f'output {final}: expected a new name (or --force to replace it), got an '
                        f'existing {"folder with something in it" if folder else "file"}'
                    )
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
