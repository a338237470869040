"""Pages of a calibration and of a conformance test."""
