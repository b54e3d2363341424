"""The rules that say which difference in sample complexity is significant: registered, looked up, fenced.

The built-in rules are in `qrlsuite.statistics.significance` and `.permutation`, which know nothing of plugins; they
enter here, by the same door as anyone's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, cast

from qrlsuite import registry, specs
from qrlsuite.errors import OptionError, PluginError, UnknownNameError, nearest
from qrlsuite.hookspecs import hookimpl
from qrlsuite.specs import RuleSpec, resolve

if TYPE_CHECKING:  # numpy, which registering does without
    from qrlsuite.statistics import Evidence, SignificanceRule
    from qrlsuite.statistics.grid import IntArray

DEFAULT = "intervals"
"""The paper's rule."""
PAPER = "paper"
"""Another name for it."""
STEPS = "steps"
"""The rule by which boards rank, with Holm's correction over all pairs of a board."""

_HERE = "qrlsuite.statistics.significance"
_PERMUTATION = "qrlsuite.statistics.permutation"


@hookimpl
def register_rules(register: Callable[[RuleSpec], None]) -> None:
    """Register the paper's rule and two permutation tests."""
    register(
        RuleSpec(
            name=DEFAULT,
            summary="the paper's (`--rule paper`): 5th to 95th percentile intervals do not overlap; per cell",
            factory=f"{_HERE}:IntervalRule",
        )
    )
    register(
        RuleSpec(
            name=STEPS,
            summary="labels of runs permuted, ratio of mean steps below all thresholds: the rule of boards "
            "and compare",
            factory=f"{_PERMUTATION}:StepsRule",
        )
    )
    register(
        RuleSpec(
            name="times",
            summary="labels of runs permuted, mean steps below each threshold; 5 percent over all thresholds",
            factory=f"{_PERMUTATION}:TimesRule",
        )
    )


def load(name: str = DEFAULT) -> SignificanceRule:
    """Return a registered rule, ready to judge; `paper` is the paper's."""
    name = DEFAULT if name == PAPER else name
    known = registry.load()
    try:
        registered = known.get(specs.RuleSpec, name)
    except UnknownNameError:
        choices = [PAPER, *known.names(specs.RuleSpec)]
        raise UnknownNameError(f"unknown rule '{name}'{nearest(name, choices)}") from None
    spec = registered.spec
    origin = f"{spec.title} of distribution '{registered.distribution}'"
    try:
        rule = resolve(spec.factory)()
    except Exception as error:
        raise PluginError(f"{origin}: {spec.factory} fails: {type(error).__name__}: {error}") from error
    if registered.distribution == "qrlsuite":
        return cast("SignificanceRule", rule)
    from qrlsuite.statistics import SignificanceRule

    if not isinstance(rule, SignificanceRule) or not callable(rule):
        raise PluginError(
            f"{origin}: {type(rule).__name__} is no rule: it needs a name, a promise and "
            "__call__(first, second), see qrlsuite.statistics.SignificanceRule"
        )
    promise = rule.promise
    if not isinstance(promise, str) or not promise.strip():
        raise PluginError(f"{origin}: its promise must be a sentence, not {promise!r}")
    return _Fenced(rule, name, promise, origin)


class _Fenced:
    """A third party's rule: whatever goes wrong in it is one error that names the distribution.

    Parameters
    ----------
    name:
        Under which it was registered.
    """

    def __init__(self, rule: SignificanceRule, name: str, promise: str, origin: str) -> None:
        self._rule, self._origin = rule, origin
        self.name = name
        self.promise = promise
        if hasattr(rule, "against"):  # boards ask for it where it exists
            self.against = self._against

    def __call__(self, first: Evidence, second: Evidence) -> Any:
        return self._checked(lambda: self._rule(first, second), first.grid.shape)

    def _against(self, first: Evidence, others: Sequence[Evidence]) -> Any:
        judge = cast(Any, self._rule).against
        return self._checked(lambda: judge(first, others), (len(others), *first.grid.shape))

    def _checked(self, judge: Callable[[], Any], shape: tuple[int, ...]) -> IntArray:
        from qrlsuite.statistics.significance import check_signs

        try:
            return check_signs(judge(), shape, self)
        except OptionError as error:
            raise PluginError(f"{self._origin}: {error}") from error
        except Exception as error:
            raise PluginError(f"{self._origin} fails: {type(error).__name__}: {error}") from error
