"""Deflate for noise: runs, repeats of the row above, and Huffman codes for all else.

What a predictor leaves of measured numbers repeats itself nowhere but in runs (bytes that were rounded
away, exponents) and from row to row (flags, what was never lit). So nothing else is looked for: eight
bytes are held against those one before and those one row before. Every zlib reads the result.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from levkas.words import put_word, word

HELPERS = "5cdcf0670a5defc2"
"""Digest of what is inlined from other files: numba keeps machine code as long as this file is the same."""

MOST_BITS = 14
"""Of a code: four of them and what is left of a byte fit in 64 bits."""
SYMBOLS, END, LONGEST, FARTHEST = 286, 256, 258, 1 << 15
STEPS = ((3, 1, 8), (11, 2, 4), (19, 4, 4), (35, 8, 4), (67, 16, 4), (131, 32, 4), (258, 1, 1))
FIRST_LENGTHS = np.array([least + step * k for least, step, count in STEPS for k in range(count)])
"""Least length of a match that each symbol from 257 on stands for (RFC 1951, 3.2.5)."""
ORDER = np.array([16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15])
LENGTH_BITS = np.array([4, 5, *[4] * 12, 5, 5, 0, 5, 4])
"""Bits of the codes that tell the lengths of codes; 17 and 18 are runs of nought (3.2.7)."""


def deflate_rows(rows: np.ndarray) -> bytes:
    """Return a zlib stream of rows of bytes, (n, width) uint8.

    Examples
    --------
    >>> import zlib
    >>> rows = np.arange(4096, dtype=np.uint8).reshape(64, 64) // 3
    >>> zlib.decompress(deflate_rows(rows)) == rows.tobytes()
    True
    """
    import imagecodecs

    data: Any = np.ascontiguousarray(rows).reshape(-1)
    made = _deflate(data, rows.shape[1] if rows.shape[1] <= FARTHEST else 0)
    return b"\x78\x01" + made.tobytes() + imagecodecs.zlibng_adler32(data).to_bytes(4, "big")


@njit(nogil=True, cache=True)
def _deflate(data, row):
    """Return a deflate stream of one block; `row` is the bytes of a row, 0 to look for runs only."""
    matches = np.empty(data.size // 8 + 1, np.int64)
    count = _find_matches(data, row, matches)
    matches = matches[:count]
    used = _count_symbols(data, matches)
    lengths = _code_lengths(used)
    codes = _codes(lengths)
    back = _distance_symbol(row)
    bits = _header(lengths, back, np.empty(1, np.uint8), False)
    for s in range(SYMBOLS):
        bits += used[s] * (lengths[s] + (_length_extra(s) if s > END else 0))
    far = 0
    for m in matches:
        far += m & 1
    bits += count + far * _distance_extra(back)
    out = np.empty(bits // 8 + 24, np.uint8)
    held = _header(lengths, back, out, True)
    return out[: _emit(data, matches, row, back, codes, out, held)]


@njit
def _find_matches(data, row, matches):
    """Write matches, start·1024 + length·2 + 1 where it is of the row above; return how many."""
    count, i, size = 0, 0, data.size
    while i + 8 <= size:
        here = word(data, i)
        distance = 0
        if i >= 1 and word(data, i - 1) == here:
            distance = 1
        elif 0 < row <= i and word(data, i - row) == here:
            distance = row
        if distance == 0:
            i += 8
            continue
        length, most = 8, min(LONGEST, size - i)
        while length + 8 <= most and word(data, i + length) == word(data, i + length - distance):
            length += 8
        while length < most and data[i + length] == data[i + length - distance]:
            length += 1
        matches[count] = i * 1024 + length * 2 + (distance != 1)
        count, i = count + 1, i + length
    return count


@njit
def _count_symbols(data, matches):
    """Return how often each symbol is used."""
    four = np.zeros((4, 256), np.int64)
    used = np.zeros(SYMBOLS, np.int64)
    i = 0
    for k in range(len(matches) + 1):
        start = matches[k] >> 10 if k < len(matches) else data.size
        while i + 8 <= start:
            eight = word(data, i)
            for j in range(8):
                four[j & 3, eight & np.uint64(255)] += 1
                eight >>= np.uint64(8)
            i += 8
        while i < start:
            four[0, data[i]] += 1
            i += 1
        if k < len(matches):
            length = matches[k] >> 1 & 511
            used[_length_symbol(length)] += 1
            i += length
    for s in range(256):
        used[s] = four[0, s] + four[1, s] + four[2, s] + four[3, s]
    used[END] = 1
    return used


@njit
def _length_symbol(length):
    k = 28
    while FIRST_LENGTHS[k] > length:
        k -= 1
    return 257 + k


@njit
def _length_extra(symbol):
    return 0 if symbol < 265 or symbol == 285 else (symbol - 261) // 4


@njit
def _distance_symbol(distance):
    """Return the symbol of the distance to the row above; 1 where there is none."""
    if distance < 3:
        return 1
    power = 0
    while (distance - 1) >> (power + 1):
        power += 1
    return 2 * power + ((distance - 1) >> (power - 1) & 1)


@njit
def _distance_extra(symbol):
    return 0 if symbol < 4 else symbol // 2 - 1


@njit
def _code_lengths(used):
    """Return Huffman's lengths, none above `MOST_BITS`; of equal counts the lower symbol has the longer."""
    order, counts = np.empty(SYMBOLS, np.int64), np.empty(SYMBOLS, np.int64)
    n = 0
    for s in range(SYMBOLS):
        if used[s]:
            k = n
            while k and counts[k - 1] > used[s]:
                order[k], counts[k] = order[k - 1], counts[k - 1]
                k -= 1
            order[k], counts[k] = s, used[s]
            n += 1
    lengths = np.zeros(SYMBOLS, np.int64)
    many = _shortened(_depths(counts[:n]))
    k = 0
    for bits in range(MOST_BITS, 0, -1):
        for _ in range(many[bits]):
            lengths[order[k]] = bits
            k += 1
    return lengths


@njit
def _depths(counts):
    """Return how many leaves of Huffman's tree lie at each depth; `counts` ascend."""
    n = counts.size
    # Two queues, of symbols and of what was joined, both in order.
    weight, parent = np.zeros(2 * n, np.int64), np.zeros(2 * n, np.int64)
    weight[:n] = counts
    leaf, joined = 0, n
    for made in range(n, 2 * n - 1):
        for _ in range(2):
            if leaf < n and (joined >= made or weight[leaf] <= weight[joined]):
                chosen, leaf = leaf, leaf + 1
            else:
                chosen, joined = joined, joined + 1
            weight[made] += weight[chosen]
            parent[chosen] = made
    depth, many = np.zeros(2 * n, np.int64), np.zeros(n + 1, np.int64)
    many[1] = n == 1
    for node in range(2 * n - 3, -1, -1):
        depth[node] = depth[parent[node]] + 1
        if node < n:
            many[depth[node]] += 1
    return many


@njit
def _shortened(deep):
    """Return how many codes have each length where none may be longer than `MOST_BITS`."""
    many = np.zeros(MOST_BITS + 1, np.int64)
    room = 0
    for bits in range(1, deep.size):
        least = min(bits, MOST_BITS)
        many[least] += deep[bits]
        room += deep[bits] << (MOST_BITS - least)
    # What was cut short takes too much room: others are made longer until all fit.
    while room > 1 << MOST_BITS:
        many[MOST_BITS] -= 1
        for bits in range(MOST_BITS - 1, 0, -1):
            if many[bits]:
                many[bits] -= 1
                many[bits + 1] += 2
                break
        room -= 1
    return many


@njit
def _codes(lengths):
    """Return canonical codes, first bit lowest, with their lengths from bit 16 on."""
    codes = np.zeros(lengths.size, np.uint64)
    code = 0
    for bits in range(1, 16):
        for s in range(lengths.size):
            if lengths[s] == bits:
                turned = 0
                for b in range(bits):
                    turned |= (code >> b & 1) << (bits - 1 - b)
                codes[s] = turned | bits << 16
                code += 1
        code <<= 1
    return codes


@njit
def _header(lengths, back, out, write):
    """Write the head of a last block with codes of its own; return its bits.

    The two distances, 1 and that of the row above, have codes of one bit.
    """
    told = np.zeros(SYMBOLS + back + 1, np.int64)
    told[:SYMBOLS] = lengths
    told[SYMBOLS] = told[SYMBOLS + back] = 1
    codes = _codes(LENGTH_BITS)
    at = _put(out, 0, 1 | 2 << 1 | (SYMBOLS - 257) << 3 | back << 8 | (19 - 4) << 13, 17, write)
    for s in ORDER:
        at = _put(out, at, LENGTH_BITS[s], 3, write)
    i = 0
    while i < told.size:
        run = 0
        while i + run < told.size and told[i + run] == 0 and run < 138:
            run += 1
        symbol = 18 if run > 10 else (17 if run > 2 else told[i])
        at = _put(out, at, np.int64(codes[symbol]) & 0xFFFF, LENGTH_BITS[symbol], write)
        if run > 10:
            at = _put(out, at, run - 11, 7, write)
        elif run > 2:
            at = _put(out, at, run - 3, 3, write)
        i += run if run > 2 else 1
    return at


@njit
def _put(out, at, value, bits, write):
    """Write some bits from bit `at` on; return where they end."""
    if write:
        for b in range(bits):
            place = (at + b) >> 3
            if (at + b) & 7 == 0:
                out[place] = 0
            out[place] |= np.uint8((value >> b & 1) << ((at + b) & 7))
    return at + bits


@njit
def _emit(data, matches, row, back, codes, out, at):
    """Write bytes and matches from bit `at` on, and the end; return how many bytes that makes."""
    bits, n, to = np.uint64(0), np.uint64(at & 7), at >> 3
    if n:
        bits = np.uint64(out[to])
    low, high, byte, eight_bits = np.uint64(0xFFFF), np.uint64(16), np.uint64(255), np.uint64(8)
    three, seven, whole = np.uint64(3), np.uint64(7), np.uint64(56)
    i = 0
    for k in range(len(matches) + 1):
        start = matches[k] >> 10 if k < len(matches) else data.size
        while i + 8 <= start:
            eight = word(data, i)
            for _ in range(2):
                for _ in range(4):
                    code = codes[eight & byte]
                    bits |= (code & low) << n
                    n += code >> high
                    eight >>= eight_bits
                put_word(out, to, bits)
                to, bits, n = to + np.int64(n >> three), bits >> (n & whole), n & seven
            i += 8
        while i < start:
            bits |= (codes[data[i]] & low) << n
            n += codes[data[i]] >> high
            put_word(out, to, bits)
            to, bits, n = to + np.int64(n >> three), bits >> (n & whole), n & seven
            i += 1
        symbol, extra, rest = END, 0, 0
        if k < len(matches):
            length = matches[k] >> 1 & 511
            symbol = _length_symbol(length)
            extra, rest = _length_extra(symbol), length - FIRST_LENGTHS[symbol - 257]
            i += length
        bits |= (codes[symbol] & low) << n
        n += codes[symbol] >> high
        bits |= np.uint64(rest) << n
        n += np.uint64(extra)
        if k < len(matches):
            far = matches[k] & 1
            bits |= np.uint64(far) << n
            n += np.uint64(1)
            if far and back > 3:
                extra = _distance_extra(back)
                bits |= np.uint64((row - 1) & ((1 << extra) - 1)) << n
                n += np.uint64(extra)
        put_word(out, to, bits)
        to, bits, n = to + np.int64(n >> three), bits >> (n & whole), n & seven
    return to + (n > 0)
