# SPDX-License-Identifier: Apache-2.0
"""Texts that YAML libraries fail on, or work on for long; and any text."""

from hypothesis import strategies as st

# As st.text(), which first makes a table of all of Unicode: seconds in a clean checkout.
ANY_TEXT = st.lists(st.integers(0, 0x10FFFF).map(chr)).map(''.join)

LAUGHS = 'a: &a {' + ', '.join(f'{k}: x' for k in range(9)) + '}\n'
for one, other in zip('abcdefgh', 'bcdefghi', strict=True):
    LAUGHS += f'{other}: &{other} {{' + ', '.join(f'{k}: *{one}' for k in range(9)) + '}\n'

HOSTILE = {
    'date': '2020-99-99', 'float': '!!float x', 'bool': '!!bool x', 'timestamp': '!!timestamp x',
    'binary': '!!binary \u00e9', 'map': '!!map x', 'list as key, tagged': '!!seq x: 1',
    'python': '!!python/object/apply:os.system [true]', 'long tag': '!<' + 'a' * 100_000 + '> b',
    'empty binary integer': '0b_', 'empty hexadecimal integer': '[0x_]',
    '4301 digits': '1' * 4301, 'hexadecimal digits': '0x' + 'f' * 4000,
    'closed brackets': '[' * 1000 + ']' * 1000, '50000 brackets': '[' * 50_000,
    'dashes': '- ' * 50_000, '50000 question marks': '? ' * 50_000,
    'deep mapping': ''.join(' ' * k + 'a:\n' for k in range(1000)),
    'list as key': '{[a]: 1}', 'recursive list': '&a [*a]', 'laughs': LAUGHS,
    'key twice': '{a: 1, a: 2}', 'merge': '{<<: 3}', 'value': '=',
    'two documents': 'a\n---\nb', 'many values': '[' + '1,' * 200_000 + ']',
    'long text': 'a' * 900_000, 'very long text': 'a' * 2_000_000,
    'directives': '%TAG ! a\n' * 10_000, 'half a list': '[1, 2', 'quote': '"', 'escape': '"\\xZZ"',
    'tab': '\t- a', 'next line': 'a\x85b: [', 'line separator': '[\u2028',
    'byte order mark': '[\ufeff', 'control character': '[\x07', 'at sign': '@',
}  # fmt: skip
"""Texts by what is odd about them."""
