"""Drivers of sensors on serial lines, IIO, CAN and UDP."""
