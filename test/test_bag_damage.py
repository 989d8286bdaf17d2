# SPDX-License-Identifier: Apache-2.0
"""A damaged bag gives the right samples or an error, never wrong samples."""

import shutil
import sqlite3

import bag_files as files
import bag_variants as variants
from fhaosmo_ros.tools.bags.repair import repair
from fhaosmo_ros.tools.bags.topics import series
from fhaosmo_ros.tools.bags.writer import BagWriter
from fhaosmo_ros.tools.replay import command as replay
from mcap.writer import CompressionType
import numpy as np
import pytest

COUNT = 400
FLIPS = 30


def run(*arguments):
    return replay.main([str(a) for a in arguments])


def samples(path):
    """What a replay has read and estimated."""
    with np.load(path) as arrays:
        return {name: arrays[name] for name in ('stamp_ns', 'y', 'unknown_input')}


@pytest.fixture(name='bag')
def _bag(tmp_path):
    """A bag of our own: one that was replayed."""
    stamps, y = files.signal(COUNT)
    source = files.write(tmp_path / 'source', files.floats(stamps, y))
    assert run(source, '-o', tmp_path / 'bag') == 0
    return tmp_path / 'bag'


def test_single_bits_give_the_right_samples_or_an_error(bag, tmp_path, capsys):
    (file,) = bag.glob('*.mcap')
    whole = file.read_bytes()
    out = tmp_path / 'out.npz'
    assert run(bag, '-o', out) == 0
    expected = samples(out)
    rng = np.random.default_rng(17)
    codes = []
    for at, bit in zip(rng.integers(0, len(whole), FLIPS), rng.integers(0, 8, FLIPS), strict=True):
        data = bytearray(whole)
        data[at] ^= 1 << bit
        file.write_bytes(data)
        out.unlink(missing_ok=True)
        # The copy makes it read all topics.
        codes.append(run(bag, '-o', out, '-o', tmp_path / 'copy', '--force'))
        error = capsys.readouterr().err
        assert 'Traceback' not in error
        if codes[-1] == 0:
            for name, values in samples(out).items():
                np.testing.assert_array_equal(values, expected[name], f'bit {bit} of byte {at}')
        else:
            assert codes[-1] == 2
            assert not out.exists()
    assert codes.count(2) > FLIPS // 2


def test_summary_is_checked_too(bag, tmp_path, capsys):
    """It holds the topics' types and where the chunks are."""
    (file,) = bag.glob('*.mcap')
    data = bytearray(file.read_bytes())
    data[data.rindex(b'float64 data') + 5] = ord('3')  # as ever of 8 bytes, for who does not look
    file.write_bytes(data)
    assert run(bag, '-o', tmp_path / 'out.npz') == 2
    assert 'CRC' in capsys.readouterr().err


def without_last_chunk(folder):
    """A bag that lists more messages than are there."""
    stamps, y = files.signal(COUNT)
    bag = variants.write(folder, files.floats(stamps, y), 'jazzy', 'sqlite3', 'plain')
    with sqlite3.connect(bag / 'bag_0.db3') as database:
        database.execute('DELETE FROM messages WHERE id > 390')
    database.close()
    return bag


def with_other_statistics(folder):
    stamps, y = files.signal(COUNT)
    bag = variants.write(folder, files.floats(stamps, y), 'jazzy', 'mcap', 'plain')
    text = (bag / 'metadata.yaml').read_text()
    (bag / 'metadata.yaml').write_text(text.replace('message_count: 400', 'message_count: 410'))
    return bag


@pytest.mark.parametrize('make', [without_last_chunk, with_other_statistics])
def test_messages_that_are_listed_and_not_there_are_an_error(make, tmp_path, capsys):
    bag = make(tmp_path / 'bag')
    assert run(bag, '-o', tmp_path / 'out.npz') == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert '/y' in lines[0]
    assert 'messages on' in lines[0]
    assert 'record --repair' in lines[0]


@pytest.mark.parametrize(
    ('storage', 'how', 'told'),
    [('mcap', 'zstd', 0), ('mcap', 'zstd_fast', 1), ('mcap', 'fastwrite', 1),
     ('sqlite3', 'plain', 1)],
)  # fmt: skip
def test_bag_without_checksums_is_told_once(storage, how, told, tmp_path, capsys):
    stamps, y = files.signal(3000)
    bag = variants.write(tmp_path / 'bag', files.floats(stamps, y), 'jazzy', storage, how)
    assert run(bag, '-o', tmp_path / 'out.npz') == 0
    assert capsys.readouterr().out.count('no checksums') == told


def test_fastwrite_out_of_order_is_put_in_order(tmp_path, monkeypatch):
    """Messages outside chunks, a few milliseconds late at random."""
    stamps, y = files.signal(3000)
    messages = files.floats(stamps, y)
    monkeypatch.setitem(
        variants.MCAP, 'plain', {'compression': CompressionType.NONE, 'use_chunking': False}
    )
    order = np.argsort(np.arange(3000) + np.random.default_rng(3).uniform(0, 7, 3000))
    bag = variants.write(tmp_path / 'bag', [messages[k] for k in order], 'jazzy', 'mcap', 'plain')
    assert run(bag, '-o', tmp_path / 'out.npz') == 0
    np.testing.assert_array_equal(samples(tmp_path / 'out.npz')['y'], y)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_compressed_messages_without_metadata(storage, tmp_path):
    """Only metadata.yaml says that they are compressed."""
    stamps, y = files.signal(COUNT)
    bag = tmp_path / 'bag'
    files.write_compressed(bag, files.floats(stamps, y), storage, 'message')
    (file,) = [p for p in bag.iterdir() if p.suffix in ('.mcap', '.db3')]
    (bag / 'metadata.yaml').unlink()
    assert run(file, '-o', tmp_path / 'out.npz', '-o', tmp_path / 'out') == 0
    repair(bag, tmp_path / 'saved', storage)
    for made in (tmp_path / 'out', tmp_path / 'saved'):
        np.testing.assert_array_equal(series(made, '/y').values, y)
    np.testing.assert_array_equal(samples(tmp_path / 'out.npz')['y'], y)


def recorded(path, storage):
    """Write as the recorder does, which flushes now and then."""
    stamps, y = files.signal(6000)
    with BagWriter(path, storage) as bag:
        bag.add('/y', 'std_msgs/msg/Float64')
        for k, (stamp, value) in enumerate(zip(stamps.tolist(), y.tolist(), strict=True)):
            bag.write('/y', stamp, files.float64(value))
            if k % 300 == 0:
                bag.flush()
    return dict(zip(stamps.tolist(), y.tolist(), strict=True))


def saved(bag, out, storage, truth):
    """Return the share of the messages that a repair saves, all of them right."""
    _, missing = repair(bag, out, storage)
    found = series(out, '/y')
    assert all(truth[s] == v for s, v in zip(found.stamps.tolist(), found.values, strict=True))
    if len(found.stamps) < len(truth):
        assert missing
    shutil.rmtree(out)
    return len(found.stamps) / len(truth)


def test_repair_of_mcap_leaves_out_the_damaged_chunk_only(tmp_path):
    bag = tmp_path / 'bag'
    truth = recorded(bag, 'mcap')
    (file,) = bag.glob('*.mcap')
    whole = file.read_bytes()
    rng = np.random.default_rng(2)
    for at in [30, len(whole) - 600, *rng.integers(8, len(whole) - 512, 8).tolist()]:
        file.write_bytes(whole[:at] + bytes(512) + whole[at + 512 :])
        assert saved(bag, tmp_path / 'out', 'mcap', truth) > 0.88, at


@pytest.mark.parametrize('where', [0.3, 0.72, 0.95])
def test_repair_of_sqlite_saves_what_was_not_cut_off(where, tmp_path):
    bag = tmp_path / 'bag'
    truth = recorded(bag, 'sqlite3')
    (file,) = bag.glob('*.db3')
    whole = file.read_bytes()
    file.write_bytes(whole[: int(where * len(whole))])
    assert saved(bag, tmp_path / 'out', 'sqlite3', truth) > where - 0.1


def test_repair_of_sqlite_leaves_out_rows_that_are_not_whole(tmp_path):
    """sqlite3 has no checksums: zeros in a page are rows without numbers."""
    bag = tmp_path / 'bag'
    truth = recorded(bag, 'sqlite3')
    (file,) = bag.glob('*.db3')
    whole = file.read_bytes()
    for at in np.random.default_rng(2).integers(30_000, len(whole) - 512, 10).tolist():
        file.write_bytes(whole[:at] + bytes(512) + whole[at + 512 :])
        assert saved(bag, tmp_path / 'out', 'sqlite3', truth) > 0.9, at


def test_repair_of_fastwrite_goes_on_behind_the_damage(tmp_path):
    """Messages outside chunks."""
    stamps, y = files.signal(COUNT)
    bag = variants.write(tmp_path / 'bag', files.floats(stamps, y), 'jazzy', 'mcap', 'fastwrite')
    (file,) = bag.glob('*.mcap')
    whole = file.read_bytes()
    at = len(whole) // 2
    file.write_bytes(whole[:at] + bytes(512) + whole[at + 512 :])
    truth = dict(zip(stamps.tolist(), y.tolist(), strict=True))
    assert saved(bag, tmp_path / 'out', 'mcap', truth) > 0.9


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_repair_of_several_files(storage, tmp_path):
    stamps, y = files.signal(COUNT)
    bag = variants.write(tmp_path / 'bag', files.floats(stamps, y), 'jazzy', storage, 'plain', 3)
    count, missing = repair(bag, tmp_path / 'out', storage)
    assert (count, missing) == (COUNT, [])
    np.testing.assert_array_equal(series(tmp_path / 'out', '/y').values, y)
