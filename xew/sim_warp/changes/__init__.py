"""One change at a time: a scene with one factor (`xew.protocol.FACTORS`) at a level, and all else as it was.

`scenes` makes the changed scene and its plan, `looks` its lights, surfaces and camera, `patterns` the images on surfaces, and
`clutter` objects that nothing needs. All are functions of the change, and clutter of the scene, too; none knows the robot.
"""

__all__ = ["clutter", "looks", "patterns", "scenes"]
