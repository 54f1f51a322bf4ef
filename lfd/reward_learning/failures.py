"""What reward learning reports when there is no answer."""

from lfd.core.errors import InputError, LfdError


class Infeasible(InputError):
    """No weights satisfy every constraint."""


class NotConcave(InputError):
    """The reward has no negative definite curvature at a demonstration, which is then no strict local optimum."""


class SolverFailed(LfdError):
    """A solver stopped without an answer; the message names it and its status."""
