"""The follower's loop: a slice of the fit between sensors and modem."""

from firmware.vehicle_loop import VehicleLoop, Work


class FollowerLoop(VehicleLoop):
    """A vehicle's loop whose work is the fit."""

    def _tasks(self) -> tuple[Work, ...]:
        return (
            # Deadlines: hear, sense and fit leave the last fifth of a period to a frame.
            ("hear", 0.1, self._hear),
            ("sense", 0.2, self._sense),
            ("fit", 0.5, self.core.tick),
            ("speak", 0.2, self._speak),
        )
