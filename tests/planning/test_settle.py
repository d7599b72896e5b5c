"""What is there before a loop is no longer walked through by collections; what comes later is still collected."""

import gc
import weakref

from latentplan.planning import settle


class Knot:
    """Refers to itself, so that only a collection frees it."""

    def __init__(self):
        self.itself = self


def test_later_garbage_is_still_collected():
    frozen_before = gc.get_freeze_count()
    try:
        early = Knot()
        reference = weakref.ref(early)
        settle()
        assert gc.get_freeze_count() > frozen_before
        del early
        gc.collect()
        assert reference() is not None  # it was taken out
        late = weakref.ref(Knot())
        gc.collect()
        assert late() is None
    finally:
        gc.unfreeze()


def test_garbage_from_before_is_collected_first():
    try:
        reference = weakref.ref(Knot())
        settle()
        assert reference() is None
    finally:
        gc.unfreeze()
