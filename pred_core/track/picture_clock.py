"""Which pictures are of now: the clock of one camera may be wrong, and a recording may begin anew."""

from __future__ import annotations

from pred_core.errors import InputError

LEAP = 1_500_000_000  # [ns] a stamp farther from the newest is believed when others confirm it; a reset cell skips 1 s
ALONE = 3  # pictures of one camera in a row that confirm each other, where no other camera contradicts


class PictureClock:
    """The time line of all cameras."""

    def __init__(self) -> None:
        self._newest: int | None = None  # [ns]
        self._cameras: set[str] = set()  # those with a picture on the time line
        self._held: dict[str, list[int]] = {}  # camera -> its last stamps off the time line, near to each other

    def take(self, camera: str, stamp: int) -> int:
        """By how much [ns] time leaps with this picture, forwards or back; 0 where it goes on.

        Raises: InputError for a picture off the time line, unless another camera's or two more of its own confirm it.
        """
        if self._newest is None or abs(stamp - self._newest) <= LEAP:
            self._newest = max(stamp, self._newest or stamp)
            self._cameras.add(camera)
            self._held.clear()
            return 0
        own = self._held.get(camera, [])
        own = [*own, stamp] if own and 0 < stamp - own[-1] <= LEAP else [stamp]
        others = [stamps[-1] for name, stamps in self._held.items() if name != camera]
        leap = stamp - self._newest
        if len(own) < ALONE and not any(abs(stamp - other) <= LEAP for other in others):
            self._held[camera] = own
            rest = "the others" if self._cameras - {camera} else "its last one"
            raise InputError(
                f"{camera}: a picture {abs(leap) * 1e-9:.1f} s {'ahead of' if leap > 0 else 'behind'} {rest}",
                got=f"stamp {stamp * 1e-9:.3f} s",
                allowed=f"within {LEAP * 1e-9:g} s of {self._newest * 1e-9:.3f} s",
                next_step="Not used unless more confirm it; after an outage they do, else check the camera's clock",
            )
        self._newest = stamp
        self._cameras = {camera}
        self._held.clear()
        return leap
