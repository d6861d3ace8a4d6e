"""Registry of tasks: one file each with the functions sample, plan, success and approach.

To add one, write a file with `TASK = Task(...)` here and add its line to `TASKS`; outside the repository write it
anywhere importable and name it `module:TASK` wherever a task is asked for.
"""

from xew.config import pick, pick_recorded
from xew.sim_warp.tasks import (
    beat_block_hammer,
    blocks_ranking_rgb,
    blocks_ranking_size,
    grab_roller,
    lift_pot,
    move_can_pot,
    move_pillbottle_pad,
    move_stapler_pad,
    open_laptop,
    place_a2b_left,
    place_a2b_right,
    place_bread_basket,
    place_burger_fries,
    place_container_plate,
    place_dual_shoes,
    place_empty_cup,
    place_mouse_pad,
    place_object_scale,
    place_object_stand,
    place_phone_stand,
    press_stapler,
    shake_bottle,
    shake_bottle_horizontally,
    stack_bowls_two,
    stamp_seal,
)
from xew.sim_warp.tasks.task import Moment, Task

__all__ = ["TASKS", "Moment", "Task", "get_task", "recorded_task"]

TASKS: dict[str, Task] = {
    "beat_block_hammer": beat_block_hammer.TASK,
    "blocks_ranking_rgb": blocks_ranking_rgb.TASK,
    "blocks_ranking_size": blocks_ranking_size.TASK,
    "grab_roller": grab_roller.TASK,
    "lift_pot": lift_pot.TASK,
    "move_can_pot": move_can_pot.TASK,
    "move_pillbottle_pad": move_pillbottle_pad.TASK,
    "move_stapler_pad": move_stapler_pad.TASK,
    "open_laptop": open_laptop.TASK,
    "place_a2b_left": place_a2b_left.TASK,
    "place_a2b_right": place_a2b_right.TASK,
    "place_bread_basket": place_bread_basket.TASK,
    "place_burger_fries": place_burger_fries.TASK,
    "place_container_plate": place_container_plate.TASK,
    "place_dual_shoes": place_dual_shoes.TASK,
    "place_empty_cup": place_empty_cup.TASK,
    "place_mouse_pad": place_mouse_pad.TASK,
    "place_object_scale": place_object_scale.TASK,
    "place_object_stand": place_object_stand.TASK,
    "place_phone_stand": place_phone_stand.TASK,
    "press_stapler": press_stapler.TASK,
    "shake_bottle": shake_bottle.TASK,
    "shake_bottle_horizontally": shake_bottle_horizontally.TASK,
    "stack_bowls_two": stack_bowls_two.TASK,
    "stamp_seal": stamp_seal.TASK,
}


def get_task(name: str) -> Task:
    """The task of a registry key, or of an import path `module:NAME`. Raises ConfigError if there is none."""
    return pick(TASKS, name, "task")


def recorded_task(name: str) -> Task:
    """The task that an episode names. Raises UntrustedError where its module is not admitted, ConfigError if there is none."""
    return pick_recorded(TASKS, name, "task")
