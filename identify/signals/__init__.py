"""Signal processing: smoothing, differentiation and decimation of measured signals."""
