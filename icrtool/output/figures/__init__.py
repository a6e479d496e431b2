"""Results as figures. The only package that imports matplotlib."""
