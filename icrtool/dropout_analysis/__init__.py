"""Analysis of GNSS dropouts (Pentzer 2014, Section 6.4): open-loop trials, outages, acceptance limits."""
