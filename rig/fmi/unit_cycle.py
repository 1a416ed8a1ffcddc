"""One communication step of an exported unit, as a function for `plant.model.build_kernel`."""

from typing import Any

from plant import (
    control_plant,
    load_control,
    load_readings,
    pack_state,
    read_sensors,
    show_start,
    step_cycle,
    store_control,
    store_readings,
    take_demand,
    unpack_state,
)

CYCLES, ANSWER, CONTROL = 0, 1, 2  # of `loop`: cycles of the plant, -1: not started; answer, memory of the controller
INPUTS = 5


def advance_unit(flat: Any, loop: Any, inputs: Any, noise: Any, record: Any, steps: int, out: Any) -> None:
    """Advance a unit by one cycle and read its sensors, with the numbers of `plant.solve.run_closed_loop`.

    A unit that has not started stays where it is: only its sensors are read.

    Args:
        flat: state of the plant, changed in place.
        loop: state of the sampled loop, changed in place.
        inputs: (INPUTS,) demand, drive and load of this cycle; 1 where the controller closes the loop, so that its
            answer to the cycle before drives the plant; and the standard normal number of effects that are noise.
        noise: (outputs + 1,) standard normal numbers of the cycle that follows, whose readings these are.
        record: (1,) parameters of the model.
        steps: of the solver, a cycle.
        out: (outputs + 1,) readings at the end, and the controller's answer; holds those at the start.
    """
    p = record[0]
    s, m = unpack_state(flat, 0)
    if loop[CYCLES] < 0.0:
        s = show_start(s, m, p)
    else:
        t = loop[CYCLES] * p.controller.period
        drive = inputs[1]
        if inputs[3] > 0.0:
            drive = loop[ANSWER]
            y = load_readings(out)
            demand, m = take_demand(inputs[0], m, y[0], t, p)
            loop[ANSWER], c = control_plant(load_control(loop, 0), demand, y, p)
            store_control(c, loop, 0)
        s, m = step_cycle(s, m, drive, inputs[2], inputs[4], t, record, steps)
    loop[CYCLES] += 1.0
    y, m = read_sensors(s, m, noise, loop[CYCLES] * p.controller.period, p)
    store_readings(y, out)
    out[len(y)] = loop[ANSWER]
    pack_state((s, m), flat, 0)
