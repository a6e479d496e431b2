"""The records that packages exchange. They hold data and know no code that makes or uses them."""
