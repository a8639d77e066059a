"""Evidence room by room: what two maps show of one place, seen from above, and how much it speaks for a pose."""
