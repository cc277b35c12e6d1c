"""A note of the service: its simulated sensor sees another ground than the simulated robot moves over."""

from __future__ import annotations

import click


class GroundNote:
    """Says once on stderr that the service's simulated sensor sees another ground."""

    def __init__(self, name: str) -> None:
        self._name, self._said = name, False

    def __call__(self) -> None:
        """Look at the notes of the service."""
        from surffollow.client import observe
        from surffollow.errors import FaultError
        from surffollow.hw.simulation.ground_check import OTHER_GROUND

        if self._said:
            return
        try:
            with observe(self._name) as service:
                text = str(service.status()["main"].get("text", ""))
        except FaultError:  # it is away; the robot attaches to it again
            return
        note = next((part for part in text.split("; ") if part.startswith(OTHER_GROUND)), "")
        if note:
            self._said = True
            click.echo(f"surffollow: {note}", err=True)
