"""From a log as recorded to measurements that fit together: wheels, heading, delays, GNSS quality."""
