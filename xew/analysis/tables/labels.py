"""Names that tables and charts give to the protocol's rows: action representations, conditionings, systems, remedies."""

from xew.analysis.statistics.grades import (
    REFERENCE,
)

PAPER_METRICS = (
    "psnr", "ssim", "lpips", "mask_iou", "boundary_f1", "region_lpips", "pck", "keypoint_error", "ndtw", "trajectory_error",
)  # fmt: skip
"""The paper's suite in its order."""
SHORT_ROBOTS = {"franka_panda": "Franka", "piper": "Piper", "aloha_agilex": "Aloha", "arx_x5": "ARX", "ur5_wsg": "UR5"}
SEEN_TITLE = "Seen pool: Aloha-AgileX, ARX-X5 and UR5"
ACTIONS = {"joints": "Joint pose", "ray_map": "Ray map", "mask": "Mask", "optical_flow": "Optical flow"}
LADDER = {
    "none": "flow only",
    "reference_image": "+ reference image",
    "nine_views": "+ nine views",
    "articulation_clip": "+ articulation clip",
    "robot_render": "per-frame render",
}
SYSTEMS = {"irasim": "IRASim", "ctrl_world": "Ctrl-World", "enerverse_ac": "EnerVerse-AC", REFERENCE: "reference model"}
SYSTEM_ACTIONS = ("relative tool poses", "absolute tool poses", "tool poses + ray maps", "optical flow")
STILL, TRUE = "frozen first frame", "true video, graded"
REMEDIES = {"replay": "with replay", "lora": "with LoRA"}
