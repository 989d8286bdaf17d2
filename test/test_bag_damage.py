# SPDX-License-Identifier: Apache-2.0
"""A damaged bag gives the right samples or an error, never wrong samples."""

import sqlite3
import subprocess
import sys

import bag_files as files
import bag_variants as variants
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.bags.writer import BagWriter
from fhaosmo_ros.tools.replay import command as replay
import numpy as np
import pytest

COUNT = 1500
STAMPS, Y = files.signal(COUNT)


def recorded(path, storage='mcap'):
    """Write as the recorder does, which flushes now and then."""
    with BagWriter(path, storage) as bag:
        bag.add('/y', files.FLOAT)
        for k, (stamp, value) in enumerate(zip(STAMPS.tolist(), Y.tolist(), strict=True)):
            bag.write('/y', stamp, files.float64(value))
            if k % 250 == 0:
                bag.flush()
    return path


def storage_file(bag):
    (file,) = [p for p in bag.iterdir() if p.suffix in ('.mcap', '.db3')]
    return file


def read(path):
    """Return how many samples are read, all of them right; None for an error in one line."""
    try:
        with BagReader(path) as reader:
            found = list(reader.blocks('/y', reader.field('/y', None), 'auto'))
    except ConfigurationError as error:
        return None if '\n' not in str(error) else 'several lines'
    times, stamps, values = (np.concatenate(part) for part in zip(*found, strict=True))
    for column, expected in ((times, STAMPS), (stamps, STAMPS), (values, Y)):
        np.testing.assert_array_equal(column, expected[: len(column)])
    return len(values)


@pytest.mark.parametrize('how', ['ours', 'zstd', 'lz4'])
def test_damage_in_a_file_with_checksums_is_an_error(how, tmp_path):
    """Single bits and zeros, half of them in the summary: topics, types and where chunks are."""
    bag = tmp_path / 'bag'
    if how == 'ours':
        recorded(bag)
    else:
        variants.write(bag, files.floats(STAMPS, Y), 'jazzy', 'mcap', how)
    file = storage_file(bag)
    whole = file.read_bytes()
    rng = np.random.default_rng(17)
    results = []
    for k in range(40):
        data = bytearray(whole)
        end = len(whole) - 8  # a file without its last bytes is one that was cut
        at = int(rng.integers(0, end) if k % 2 else end - rng.integers(1, 1200))
        if k % 4 < 2:
            data[at] ^= 1 << int(rng.integers(8))
        else:
            data[at:end] = (bytes(512) + data[at + 512 : end])[: end - at]
        file.write_bytes(data)
        results += [read(bag), read(file)]
    assert set(results) <= {COUNT, None}
    assert results.count(None) > 40


@pytest.mark.parametrize('how', ['ours', 'zstd', 'lz4', 'fastwrite', 'zstd_fast'])
def test_file_that_was_cut_is_read_up_to_there(how, tmp_path, capsys):
    """As after a kill of the recorder, or on a full disk; metadata.yaml is missing then."""
    bag = tmp_path / 'bag'
    if how == 'ours':
        recorded(bag)
    else:
        variants.write(bag, files.floats(STAMPS, Y), 'jazzy', 'mcap', how)
    file = storage_file(bag)
    whole = file.read_bytes()
    for share in (0.99, 0.7, 0.31):
        cut = file.with_name(f'cut_{share}.mcap')
        cut.write_bytes(whole[: int(share * len(whole))])
        assert read(cut) > (share - 0.25) * COUNT
        assert capsys.readouterr().err.count('read up to its last whole part') == 1
    file.write_bytes(whole[:600])
    assert read(file) is None
    file.write_bytes(whole[:-2000])
    assert read(bag) is None  # metadata.yaml lists more


def test_database_whose_writer_was_killed_is_read_up_to_its_last_commit(tmp_path):
    file = tmp_path / 'bag_0.db3'
    recorded(tmp_path / 'bag', 'sqlite3')
    storage_file(tmp_path / 'bag').rename(file)
    # More than its cache holds, so that pages that were not committed are in the file.
    code = (
        'import os, sqlite3, sys\n'
        'database = sqlite3.connect(sys.argv[1])\n'
        'row = database.execute("SELECT * FROM messages").fetchone()[1:]\n'
        'database.execute("UPDATE messages SET data = zeroblob(12)")\n'
        'for _ in range(40_000):\n'
        '    database.execute("INSERT INTO messages(topic_id, timestamp, data)'
        ' VALUES (?, ?, ?)", row)\n'
        'os._exit(9)\n'
    )
    assert subprocess.run([sys.executable, '-c', code, file], check=False).returncode == 9
    before = file.read_bytes()
    assert file.with_name(f'{file.name}-journal').exists()
    assert read(file) == COUNT
    assert file.read_bytes() == before


@pytest.mark.parametrize('share', [0.3, 0.72, 0.999])
def test_database_that_was_cut_is_an_error(share, tmp_path):
    bag = recorded(tmp_path / 'bag', 'sqlite3')
    whole = storage_file(bag).read_bytes()
    storage_file(bag).write_bytes(whole[: int(share * len(whole))])
    assert read(bag) is None
    assert read(storage_file(bag)) is None


def without_last_messages(folder):
    """A bag that lists more messages than are there."""
    bag = variants.write(folder, files.floats(STAMPS, Y), 'jazzy', 'sqlite3', 'plain')
    with sqlite3.connect(bag / 'bag_0.db3') as database:
        database.execute('DELETE FROM messages WHERE id > 1490')
    database.close()
    return bag


def with_other_statistics(folder):
    bag = variants.write(folder, files.floats(STAMPS, Y), 'jazzy', 'mcap', 'plain')
    text = (bag / 'metadata.yaml').read_text()
    (bag / 'metadata.yaml').write_text(text.replace('message_count: 1500', 'message_count: 1510'))
    return bag


@pytest.mark.parametrize('make', [without_last_messages, with_other_statistics])
def test_messages_that_are_listed_and_not_there_are_an_error(make, tmp_path, capsys):
    bag = make(tmp_path / 'bag')
    assert replay.main([str(bag), '-o', str(tmp_path / 'out.npz')]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert 'messages on /y' in line
    assert '`mcap recover`' in line


@pytest.mark.parametrize(
    ('storage', 'how', 'told'),
    [('mcap', 'zstd', 0), ('mcap', 'zstd_fast', 1), ('mcap', 'fastwrite', 1),
     ('sqlite3', 'plain', 1)],
)  # fmt: skip
def test_bag_without_checksums_is_told_once(storage, how, told, tmp_path, capsys):
    bag = variants.write(tmp_path / 'bag', files.floats(STAMPS, Y), 'jazzy', storage, how)
    assert replay.main([str(bag), '-o', str(tmp_path / 'out.npz')]) == 0
    assert capsys.readouterr().out.count('no checksums') == told


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_compressed_messages_without_metadata(storage, tmp_path):
    """Only metadata.yaml says that they are compressed."""
    bag = tmp_path / 'bag'
    files.write_compressed(bag, files.floats(STAMPS, Y), storage, 'message')
    assert read(storage_file(bag)) == COUNT
