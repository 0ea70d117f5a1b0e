"""What a shot will cost, before anything runs."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.plan.cost": ("CostModel",),
        "gsfluent.plan.in_run": ("foresee_run", "judge_plan"),
        "gsfluent.plan.plan": ("cost_model", "plan_shot"),
        "gsfluent.plan.proxy": ("proxy",),
        "gsfluent.plan.work": ("laws_of",),
    },
)
