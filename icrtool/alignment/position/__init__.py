"""Position fixes: which reference, which class, how noisy, where they jump."""
