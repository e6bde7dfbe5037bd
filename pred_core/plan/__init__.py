"""Planning gripper motions with MPPI (paper III-E) through any Dynamics.

`Planner` plans from an observed state to the lowest cost; `curve` and `knots` say what a motion is, `search` is MPPI
itself, `rollouts` asks the Dynamics, `costs` and the `*_cost` modules judge, `latency` finds the state a plan begins
at, `session` replans, `offline` plans without a robot.
"""
