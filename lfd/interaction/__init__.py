"""Robots whose actions change what people do: best responses, Stackelberg plans, intent, information (chapter 10.6)."""

from importlib import import_module
from typing import Any

_PUBLIC = {
    "IntentBelief": "lfd.interaction.intent",
    "NoResponse": "lfd.interaction.responses",
    "ParticleBelief": "lfd.interaction.particles",
    "Plan": "lfd.interaction.stackelberg",
    "RecedingHorizon": "lfd.interaction.receding_horizon",
    "SingularResponse": "lfd.interaction.responses",
    "best_response": "lfd.interaction.responses",
    "boltzmann_likelihood": "lfd.interaction.intent",
    "information_gain": "lfd.interaction.information",
    "information_several_steps": "lfd.interaction.information",
    "leader_gradient": "lfd.interaction.stackelberg",
    "log_likelihood_laplace": "lfd.interaction.continuous_intent",
    "log_likelihood_quadrature": "lfd.interaction.continuous_intent",
    "log_likelihood_samples": "lfd.interaction.continuous_intent",
    "plan_stackelberg": "lfd.interaction.stackelberg",
    "response_jacobian": "lfd.interaction.responses",
}

__all__ = sorted(_PUBLIC)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(import_module(_PUBLIC[name]), name)
