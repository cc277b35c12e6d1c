"""Notes of the service about a simulated robot: another ground than its sensor sees, another axis."""

from __future__ import annotations

import click


class ServiceNotes:
    """Says once on stderr that the service's simulated sensor sees another ground.

    Attributes
    ----------
    tau : the note about a learned time constant at an end of its range, at the newest look; "": none
    """

    def __init__(self, name: str) -> None:
        self._name, self._said, self.tau = name, False, ""

    def __call__(self) -> None:
        """Look at the notes of the service."""
        from surffollow.client import observe
        from surffollow.errors import FaultError
        from surffollow.hw.simulation.ground_check import OTHER_GROUND
        from surffollow.service.plant_note import TAU_AT_END

        try:
            with observe(self._name) as service:
                text = str(service.status()["main"].get("text", ""))
        except FaultError:  # it is away; the robot attaches to it again
            return

        def beginning_with(begin: str) -> str:
            return next((part for part in text.split("; ") if part.startswith(begin)), "")

        self.tau, ground = beginning_with(TAU_AT_END), beginning_with(OTHER_GROUND)
        if ground and not self._said:
            self._said = True
            click.echo(f"surffollow: {ground}", err=True)
