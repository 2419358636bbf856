"""Metrics of a capture; their keys are those of the health message and of `Health`."""

from armident.metrics import CERTIFICATES, INFO, UPDATED, Family, Metrics

_US = 1e-6
_BUS = ("bus",)

CAPTURE = Metrics(
    "capture",
    (
        INFO,
        UPDATED,
        Family("rows", "rows_total", "Complete rows that were recorded, one per SYNC."),
        Family("rows_in_gaps", "gap_rows_total", "Rows that are in the gap list, because a sample is missing."),
        Family("rows_not_written", "lost_rows_total", "Rows that could not be written to the disk."),
        Family("rows_waiting", "waiting_rows", "Rows that wait for the disk."),
        Family("buffer_share", "write_buffer_used_ratio", "Used share of the memory for rows that wait for the disk."),
        Family("disk_free_bytes", "disk_free_bytes", "Free space on the disk of the recordings."),
        Family("frames_of", "frames_total", "CAN frames that were received.", _BUS),
        Family("kernel_drops", "dropped_frames_total", "CAN frames that the kernel dropped."),
        Family("error_frames", "error_frames_total", "Error frames of the CAN controllers."),
        Family("buses_down", "down_buses", "Buses that are down."),
        Family("load_of", "bus_load_ratio", "Share of bus time of received frames, without stuff bits.", _BUS),
        Family("plan_of", "bus_load_planned_ratio", "Share of bus time of the session in the worst case.", _BUS),
        Family("events_of", "events_total", "Events of drives and buses.", ("kind",)),
        Family("tpdo_late", "late_answers_total", "TPDOs that came after the next SYNC."),
        Family("answers_owed", "outstanding_answers", "Largest number of SYNCs that a drive has not answered."),
        Family("jitter_of", "sync_jitter_seconds", "Deviation from the SYNC period.", ("bus", "statistic"), scale=_US),
        Family("sync_late_p99_us", "sync_lateness_p99_seconds", "Delay of sent SYNCs, 99th percentile.", scale=_US),
        Family("sync_late_max_us", "sync_lateness_max_seconds", "Largest delay of sent SYNCs.", scale=_US),
        Family("sync_overruns", "late_syncs_total", "Sent SYNCs that were late by more than a period."),
        Family("sync_not_sent", "unsent_syncs_total", "SYNCs that a bus did not take."),
        Family("celsius_of", "drive_temperature_celsius", "Temperature of a drive.", ("joint",)),
        Family("queue_depth", "queued_blocks", "Blocks of samples that wait to be published on Zenoh."),
        Family("blocks_dropped", "dropped_blocks_total", "Blocks of samples that were not published."),
        Family("events_dropped", "dropped_events_total", "Events that were not published."),
        Family("zenoh_open", "zenoh_open", "1 if there is a Zenoh session, otherwise 0."),
        Family("clock_synchronised", "clock_synchronised", "1 if the system clock is synchronised, otherwise 0."),
        Family("clock_offset_us", "clock_offset_seconds", "Offset of the clock, still to be corrected.", scale=_US),
        Family("clock_error_us", "clock_error_seconds", "Estimated error of the clock.", scale=_US),
        Family("clock_largest_error_us", "clock_largest_error_seconds", "Upper bound of the clock error.", scale=_US),
        CERTIFICATES,
    ),
)
"""Metrics of a capture; statistics are those since its start."""
