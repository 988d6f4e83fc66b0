"""Identification of robots: motions that excite, constants with intervals, payload, adaptation."""
