"""Metrics of a capture; their keys are those of the health message and of `Health`."""

from typing import Final

from armident.metrics import INFO, UPDATED, Family, Metrics

_COUNTER: Final = "counter"
_US = 1e-6
_BUS = ("bus",)

CAPTURE = Metrics(
    "capture",
    (
        INFO,
        UPDATED,
        Family("rows", "rows", "Complete rows that were recorded, one per SYNC.", kind=_COUNTER),
        Family("rows_in_gaps", "gap_rows", "Rows of the gap list.", kind=_COUNTER),
        Family("rows_not_written", "lost_rows", "Rows that could not be written to the disk.", kind=_COUNTER),
        Family("rows_waiting", "waiting_rows", "Rows that wait for the disk."),
        Family("buffer_share", "write_buffer_used_ratio", "Used share of the memory for rows that wait."),
        Family("disk_free_bytes", "disk_free_bytes", "Free space on the disk of the recordings."),
        Family("frames_of", "frames", "CAN frames that were received.", _BUS, kind=_COUNTER),
        Family("kernel_drops", "dropped_frames", "CAN frames that the kernel dropped.", kind=_COUNTER),
        Family("error_frames", "error_frames", "Error frames of the CAN controllers.", kind=_COUNTER),
        Family("buses_down", "down_buses", "Buses that are down."),
        Family("load_of", "bus_load_ratio", "Bus time of the frames received, without stuff bits.", _BUS),
        Family("plan_of", "bus_load_planned_ratio", "Bus time of the session in the worst case.", _BUS),
        Family("events_of", "events", "Events of drives and buses.", ("kind",), kind=_COUNTER),
        Family("tpdo_late", "late_answers", "TPDOs that came after the next SYNC.", kind=_COUNTER),
        Family("answers_owed", "outstanding_answers", "Largest number of SYNCs that a drive has not answered."),
        Family("jitter_of", "sync_jitter_seconds", "Deviation of SYNC intervals.", ("bus", "statistic"), scale=_US),
        Family("sync_late_p99_us", "sync_lateness_p99_seconds", "Lateness of 99 % of own SYNCs.", scale=_US),
        Family("sync_late_max_us", "sync_lateness_max_seconds", "Largest lateness of own SYNCs.", scale=_US),
        Family("sync_overruns", "late_syncs", "Own SYNCs that were late by more than a period.", kind=_COUNTER),
        Family("sync_not_sent", "unsent_syncs", "Own SYNCs that a bus did not take.", kind=_COUNTER),
        Family("celsius_of", "drive_temperature_celsius", "Temperature of a drive.", ("joint",)),
        Family("queue_depth", "queued_blocks", "Blocks that wait to be published."),
        Family("blocks_dropped", "dropped_blocks", "Blocks that were not published.", kind=_COUNTER),
        Family("events_dropped", "dropped_events", "Events that were not published.", kind=_COUNTER),
        Family("zenoh_open", "zenoh_open", "1 if there is a Zenoh session, otherwise 0."),
        Family("clock_synchronised", "clock_synchronised", "1 if the system clock is synchronised, otherwise 0."),
        Family("clock_offset_us", "clock_offset_seconds", "Offset of the clock, to be corrected.", scale=_US),
        Family("clock_error_us", "clock_error_seconds", "Estimated error of the clock.", scale=_US),
        Family("clock_largest_error_us", "clock_largest_error_seconds", "Bound of its error.", scale=_US),
    ),
)
"""Metrics of a capture; statistics are those since its start."""
