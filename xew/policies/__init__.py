"""Policies and what they act in: episodes that are driven chunk by chunk, in a world model or in the simulator.

The environments are `xew.model.simulate.WorldModelEnv` and `xew.sim_warp.environment.SimulatorEnv`.
"""

__all__ = ["environment", "lerobot", "policy", "registry"]
