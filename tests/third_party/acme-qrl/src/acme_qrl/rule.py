"""A rule of thumb for significance: less than half the samples."""


class HalfRule:
    name = "half"
    promise = "none: it looks at the estimates and ignores their spread"

    def __call__(self, first, second):
        """Return (E, D): 1 where `first` needs significantly fewer samples, -1 where more, else 0."""
        fewer, more = 2 * first.point < second.point, 2 * second.point < first.point
        return fewer.astype("int8") - more.astype("int8")
