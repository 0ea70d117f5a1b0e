"""What a shot will cost, before anything runs."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    cost="CostModel",
    fact="seconds_left",
    in_run="foresee_run judge_plan",
    plan="cost_model plan_shot",
    proxy="proxy",
    work="laws_of",
)
