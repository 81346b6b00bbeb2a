"""Shared memory: the zero-copy view against zenoh's own copying API, and the pool's promises."""

from __future__ import annotations

import gc

import numpy as np
import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st
from zenoh.shm import ShmProvider

from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.pool import Pool, is_loan, seal, self_test
from endo3d.services.runtime.service import Exhausted
from endo3d.services.runtime.shm_view import View, chunk_of, find_view, probe_content


@pytest.fixture(scope="module")
def view() -> View:
    found = self_test()
    assert found is not None, "this zenoh release has no zero-copy view"
    return found


@pytest.fixture(scope="module")
def pool(view: View) -> Pool:
    return Pool(100_000, view)


@settings(max_examples=50, deadline=None)
@given(content=st.binary(min_size=1, max_size=50_000))
def test_view_shows_what_zenoh_shows(pool: Pool, content: bytes) -> None:
    chunk = pool.take(len(content))
    chunk.array()[:] = np.frombuffer(content, np.uint8)
    assert bytes(chunk.owner) == content
    assert seal(chunk).to_bytes() == content
    assert chunk.array().tobytes() == content


def test_chunks_are_cache_line_aligned(pool: Pool) -> None:
    chunks = [pool.take(1001) for _ in range(5)]
    assert {chunk.array().ctypes.data % 64 for chunk in chunks} == {0}


def test_an_array_keeps_its_chunk(pool: Pool) -> None:
    chunk = pool.take(90_000)
    chunk.array()[:] = 7
    part = chunk.array()[1000:2000].view(np.uint16).reshape(20, 25)
    payload = seal(chunk)
    del chunk, payload
    gc.collect()
    others = []
    with pytest.raises(Exhausted):  # noqa: PT012
        while True:
            others.append(pool.take(90_000))
            others[-1].array()[:] = 9
    assert (part == 0x0707).all()


def test_exhausted_until_a_chunk_is_given_back(view: View) -> None:
    small = Pool(100_000, view, slots=4)
    chunks = [small.take(100_000) for _ in range(4)]
    with pytest.raises(Exhausted):
        small.take(100_000)
    del chunks[0]
    assert is_loan(small.take(100_000))


def test_a_sealed_chunk_is_no_loan(pool: Pool) -> None:
    chunk = pool.take(100)
    assert is_loan(chunk)
    seal(chunk)
    assert not is_loan(chunk)


def test_what_is_read_can_not_be_written(pool: Pool, view: View) -> None:
    received = seal(pool.take(100)).as_shm()
    assert received is not None
    with pytest.raises(ValueError, match="read-only"):
        view(received, 100).array()[0] = 1


def test_chunk_of_finds_the_memory_behind_views(pool: Pool) -> None:
    chunk = pool.take(2400)
    array = chunk.array()[100:].view(np.float32)[5:].reshape(-1, 5)[::2]
    assert chunk_of(array) is chunk
    assert chunk_of(array.copy()) is None


def test_no_view_where_the_content_is_nowhere() -> None:
    provider = ShmProvider.default_backend(1 << 16)
    owner = provider.alloc(4099)
    owner[0:4099] = probe_content()
    assert find_view(owner, probe_content()) is None


def test_without_a_view_the_copying_api_gives_the_same() -> None:
    pool = Pool(100_000, view=None)
    content = np.random.default_rng(1).integers(0, 256, 100_000, np.uint8)
    chunk = pool.take(content.size)
    chunk.array()[:] = content
    assert chunk_of(chunk.array()[1:]) is chunk
    assert is_loan(chunk)
    payload = seal(chunk)
    assert isinstance(payload, zenoh.ZBytes)
    assert payload.as_shm() is not None
    assert payload.to_bytes() == content.tobytes()
    assert not is_loan(chunk)


def test_a_pool_larger_than_dev_shm_says_what_to_do() -> None:
    with pytest.raises(UserError, match=r"/dev/shm has .* MB free and .* needed; enlarge it .*--shm-size"):
        Pool(1 << 46, view=None)
