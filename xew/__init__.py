"""xew: can an action-conditioned world model render a robot that it has never seen?

Packages, in the order in which the data flows (docs/architecture.md):
    sim_warp   (task, seed)         -> episodes      paired data, Newton and Warp
    model      episodes             -> rollouts      video-diffusion world model, JAX
    metrics    prediction, target   -> scores        jitted functions, JAX
    analysis   scores               -> claims        tables, figures, report
The contracts between them: `xew.episode` (what an episode holds) and `xew.protocol` (who is held out).
"""

__version__ = "0.2.0"
