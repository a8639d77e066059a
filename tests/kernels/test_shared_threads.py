"""Threads of loops, shared with other processes."""

from __future__ import annotations

from topomerge.kernels import count_threads, set_thread_count, share_threads


def test_processes_that_work_share_the_threads_and_the_last_one_has_them_all() -> None:
    before, working = count_threads(), [1, 1, 0]
    try:
        set_thread_count(4)
        share_threads(working)
        assert count_threads() == 2
        working[2] = 1
        assert count_threads() == 1
        working[:] = 1, 0, 0
        assert count_threads() == 4  # what another process leaves is taken while this one goes on
        working[:] = [1] * 3
        share_threads(None)
        assert count_threads() == 4
    finally:
        share_threads(None)
        set_thread_count(before)
