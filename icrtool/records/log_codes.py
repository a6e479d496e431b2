"""The codes of findings about logs and of findings of the alignment; see `icrtool.records.note_catalogue`."""

from __future__ import annotations

from icrtool.records.explanations import Explanation

OF_FILES: dict[str, Explanation] = {
    "log_cut_off": Explanation(
        "warning",
        "The end of a file is missing, or the recorder was killed before it closed the file.",
        "Everything before the missing part is read; the drive is shorter than it was.",
        "Copy the log again from where it was recorded. If it is short there too, use the results as they are.",
    ),
    "log_damaged": Explanation(
        "warning",
        "Bytes, records, chunks or rows of a file are damaged.",
        "The damaged part is left out; there may be gaps in the drive.",
        "Copy the log again, and compare its size and checksum with the original.",
    ),
    "table_form": Explanation(
        "info",
        "The columns of a table are separated by semicolons or tabs, perhaps with decimal commas.",
        "The table is read in that form.",
        "Optional: check that the table has the named form.",
    ),
    "log_part_unreadable": Explanation(
        "warning",
        "A file of a recording, its message definitions, its write-ahead log or its metadata cannot be read.",
        "The rest of the recording is used.",
        "Check that all files of the recording are there and can be read; `ros2 bag reindex` makes new metadata.",
    ),
    "log_limit_reached": Explanation(
        "warning",
        "The log exceeds a limit that protects this machine: number of topics or entries, size when unpacked.",
        "Data beyond the limit are not read.",
        "Record fewer topics, or split the log. Do not unpack an archive that you do not trust.",
    ),
    "log_parts_contradict": Explanation(
        "warning",
        "Parts of a recording contradict each other: an index, metadata or two descriptions of one topic.",
        "Statements of the messages themselves are used; of two descriptions, the first is used.",
        "Look at the numbers of messages in `icrtool info`. Record again if topics or messages are missing.",
    ),
    "log_more_problems": Explanation(
        "warning",
        "More than 20 problems were found while a file was read.",
        "Only the first 20 are listed; the others were handled in the same manner.",
        "Copy the log again from where it was recorded.",
    ),
    "messages_unreadable": Explanation(
        "warning",
        "Messages of a used topic do not fit their type, cannot be decompressed, or have an impossible time.",
        "These messages are left out; there are gaps in the stream.",
        "Check that the driver was built with the message definitions in the log.",
    ),
    "definition_bundled": Explanation(
        "warning",
        "The message definition of a topic is damaged in the log.",
        "The definition of that name that comes with icrtool is used.",
        "Check a few values of the topic. Copy the log again, or record it with a sound definition.",
    ),
    "rows_sorted": Explanation(
        "warning",
        "The stamps of a table or of wheel messages go back.",
        "The rows are sorted by their stamps.",
        "Check that the stamps are times of the measurements. If the clock was set, use each part of the log alone.",
    ),
    "wheel_bursts": Explanation(
        "info",
        "Wheel samples arrive several at a time: a serial adapter or a radio link passes on packets.",
        "Their stamps are spread over the time since the packet before.",
        "Have the driver stamp each sample when it is measured.",
    ),
    "fix_bursts": Explanation(
        "info",
        "Positions share stamps or arrive several at a time: whole seconds, a serial adapter or a radio link.",
        "Their stamps are spread over the time since the packet before; the delay is estimated as usual.",
        "Have the driver stamp each position when it is measured.",
    ),
    "datum_far": Explanation(
        "warning",
        "The configured origin of the local plane is far from the fixes, and the plane is turned there.",
        "The first fix is the origin instead; north and east count from there.",
        "Correct `frames.datum`: latitude first, then longitude, in degrees, west and south negative.",
    ),
    "wheel_positions_restart": Explanation(
        "warning",
        "Positions of the wheels begin again: the base restarted, or lost its counts.",
        "The distance driven in that gap is not known; no trial crosses it.",
        "Nothing.",
    ),
    "stamps_shared": Explanation(
        "warning",
        "More than 1 % of the wheel samples have the stamp of another sample.",
        "The last of the samples with one stamp is used.",
        "Check whether two publishers send to one topic, or a driver gives several messages one stamp.",
    ),
    "samples_not_finite": Explanation(
        "warning",
        "More than 1 % of the wheel samples are not finite numbers.",
        "These samples are left out.",
        "Check the driver of the wheels.",
    ),
}
"""Codes of findings about files."""

OF_CLOCKS: dict[str, Explanation] = {
    "clock_shifted": Explanation(
        "warning",
        "The positions or headings have a clock that is seconds ahead of or behind the clock of the wheels.",
        "The stream was moved by that time.",
        "Set the clocks of robot and receiver; GPS time is 18 s ahead of UTC.",
    ),
    "log_time_used": Explanation(
        "warning",
        "The header stamps of a stream, or of some of its messages, are missing or wrong.",
        "The time at which the recorder received these messages is used; transport delays are then in the stream.",
        "Let the driver stamp messages with the time of the measurement. Check the delays under `alignment`.",
    ),
    "clock_set": Explanation(
        "warning",
        "The clock of a computer was set while the log was recorded, or messages are stored out of order.",
        "Stamps are moved as far as log time shows the step, else sorted; errors near that time can be too large.",
        "Fit each part alone with `--from` and `--to`. Synchronise the clocks before a recording (chrony, PTP).",
    ),
    "log_time_impossible": Explanation(
        "warning",
        "All log times lie beyond the year 2116: the clock of the recorder was wrong.",
        "Header stamps are used where all streams have them; of log times only order and intervals count.",
        "Set the clock of the computer that records.",
    ),
    "recording_looped": Explanation(
        "warning",
        "Header stamps go back and all messages come again with the same values: a replay in a loop was recorded.",
        "The first pass is used; the others would count the same errors again.",
        "Give the original recording, or record a replay without a loop.",
    ),
    "recording_paused": Explanation(
        "warning",
        "A stream has no samples for more than ten minutes.",
        "The wheels show nothing of the motion in that time; no trial crosses it.",
        "If the clock was set forward, fit the part that you need with `--from` and `--to`.",
    ),
    "samples_days_apart": Explanation(
        "warning",
        "Samples are more than a day apart from the others: the log holds two recordings, or the clock was set.",
        "The part with the most samples is used, the others are left out.",
        "Read the other part with `--from` and `--to`.",
    ),
    "delay_corrected": Explanation(
        "info",
        "The motion of this drive shows that positions or headings lag the wheels.",
        "The stream is moved by the delay.",
        "Nothing. `frames.reference_delay_s` and `frames.heading_delay_s` set a known delay.",
    ),
}
"""Codes of findings about clocks."""

OF_WHEELS: dict[str, Explanation] = {
    "ground_changed": Explanation(
        "warning",
        "From a time on, the same turn of the wheels turns the robot differently: other ground, load or tyre pressure.",
        "ICRs and multiplier of the whole drive lie between the values of its stretches.",
        "Fit with `--terrain-change T`, or each stretch by itself with `--from` and `--to`.",
    ),
    "wheel_clock_differs": Explanation(
        "warning",
        "The delay between wheels and headings grows during the drive: their clocks have different rates.",
        "Wheels and headings are compared at times that differ by a fraction of a second or more.",
        "Put both on one clock; `topics.clock=log` takes log times.",
    ),
    "wheels_limited": Explanation(
        "warning",
        "The wheel speeds end at a largest value that they hold, and the robot moves more there than elsewhere.",
        "ICRs and multiplier describe speeds that were cut off at this value.",
        "Record the speeds before they are cut off, or drive more slowly.",
    ),
    "wheels_from_pose": Explanation(
        "warning",
        "The twist of an odometry stays 0 while its pose moves.",
        "Distance and turn of the pose are taken as wheel odometry.",
        "Let the driver fill the twist, or record the wheels; `topics.wheels` chooses a topic.",
    ),
    "wheels_commanded": Explanation(
        "warning",
        "No measured wheel speeds were found: the topic holds commanded speeds.",
        "The difference between commands and wheel speeds goes into the ICRs and delays.",
        "Record encoders or joint states. `topics.wheels` chooses a topic.",
    ),
    "wheel_dead": Explanation(
        "warning",
        "One wheel never turns while the other wheels of its side do.",
        "It is left out; the others of the side are used.",
        "Check its encoder.",
    ),
    "side_dead": Explanation(
        "warning",
        "The wheels of one side hardly ever move while the other side drives.",
        "The ICRs are wrong if an encoder is dead.",
        "Check the encoders. `topics.wheels` chooses another topic, `--from` and `--to` read the sound part.",
    ),
    "sides_equal": Explanation(
        "warning",
        "Left and right wheels are equal throughout while the robot turns.",
        "The ICRs are wrong: one side is a copy of the other, or the robot steers as a car does.",
        "Choose a topic with both sides by `topics.wheels`.",
    ),
    "second_publisher": Explanation(
        "warning",
        "Messages that repeat one state, often zeros, come between others that state another motion: two publishers.",
        "The messages that repeat themselves are left out.",
        "Stop the second publisher, or give it another topic.",
    ),
    "wheels_joined": Explanation(
        "info",
        "Each wheel, or each side, is stated in messages of its own.",
        "They are joined by time: positions are interpolated, speeds held.",
        "Nothing. Wheels in one message have no error of time.",
    ),
    "counter_begins_again": Explanation(
        "info",
        "The numbers of a wheel begin again at a limit, as counters of few bits and angles do.",
        "The numbers are continued beyond the limit.",
        "Optional: check the named limit.",
    ),
    "header_clock": Explanation(
        "info",
        "All header stamps come from one clock, and log time differs from it, as in a simulation or a replay.",
        "The header stamps are used.",
        "Nothing. `topics.clock` sets which stamps are used.",
    ),
    "gyro_in_degrees": Explanation(
        "info",
        "The turn rates of an inertial unit agree with headings or fixes in deg/s, not in rad/s.",
        "They are converted.",
        "Optional: send rad/s (REP-103).",
    ),
    "joints_not_used": Explanation(
        "warning",
        "`wheels.left_joints` or `right_joints` is configured, and the messages list no joints by name.",
        "The lists have no effect.",
        "Remove the lists, or choose a topic with joint states by `topics.wheels`.",
    ),
    "wheels_from_twist": Explanation(
        "warning",
        "The wheels were read from a body twist, which holds the multipliers of its controller.",
        "The separation of the ICRs and a calibration refer to the width that the twist was made with.",
        "Set `wheels.twist_width_m` to the track width times the multiplier of the controller, or record encoders.",
    ),
    "wheels_fused": Explanation(
        "warning",
        "The wheel topic turns exactly as the gyro does: it is the output of a filter.",
        "It shows no slip; the ICRs are too close together.",
        "Name the topic of the wheels themselves with `topics.wheels`.",
    ),
    "wheel_unit_found": Explanation(
        "info",
        "The position reference shows that wheel speeds are not in the unit of their message type.",
        "They are read in the unit that fits.",
        "Optional: check the driver.",
    ),
    "wheel_unit_estimated": Explanation(
        "info",
        "A wheel radius, an encoder resolution or the unit of the wheels is not known.",
        "It is estimated from the position reference; a scale error of the wheels cannot be seen.",
        "Set `robot.wheel_radius_m` and `robot.encoder_counts_per_rev`.",
    ),
    "wheel_speeds_impossible": Explanation(
        "warning",
        "Wheel speeds are beyond what a robot can drive, or unlike the samples around them.",
        "These samples are left out.",
        "Check whether encoder counters were reset or overflow.",
    ),
    "wheel_gaps_bridged": Explanation(
        "info",
        "Samples of wheel positions are missing.",
        "The distance that the positions show is driven at constant speed in the gaps.",
        "Optional: look for messages lost by the recorder.",
    ),
    "distance_is_lower_limit": Explanation(
        "info",
        "In a gap, wheel samples and positions are missing, and the robot is in another place after it.",
        "The path in the gap is at least as long as the straight line that is counted.",
        "Nothing for the ICRs. Look for messages lost by the recorder.",
    ),
    "wheel_values_held": Explanation(
        "warning",
        "Wheel values repeat the one before while the robot moves: the driver sends faster than it measures.",
        "Speeds lag by up to one interval of the measurement.",
        "Let the driver send each measurement once.",
    ),
    "wheels_slip": Explanation(
        "warning",
        "Distance or turns of the wheels differ from the robot's distance or turns by changing amounts, as on ice.",
        "No scale and no delay is corrected; the errors without GNSS are large.",
        "Nothing on ice, mud and loose ground. On other ground check tyres, tracks and encoders.",
    ),
    "wheel_scale_corrected": Explanation(
        "info",
        "The robot goes further or less far than the wheels report.",
        "Both sides are scaled by the estimate.",
        "Nothing. `wheels.left_scale` and `wheels.right_scale` set known scales.",
    ),
    "wheel_size_wrong": Explanation(
        "warning",
        "The robot goes another distance than the wheels report, by a constant factor beyond tyres and soil.",
        "Both sides are scaled by the estimate: wheel radius, encoder resolution, gear or unit are wrong.",
        "Correct `robot.wheel_radius_m`, `robot.encoder_counts_per_rev` or `wheels.unit`, or set `wheels.left_scale`.",
    ),
    "wheel_scale_differs": Explanation(
        "warning",
        "The robot goes further or less far than the wheels report, and the wheels are not corrected.",
        "Distances by the wheels are wrong by that share.",
        "Check wheel radius, encoder resolution and units; then set `wheels.left_scale` and `wheels.right_scale`.",
    ),
    "side_scale_corrected": Explanation(
        "info",
        "One side goes less far than the other where both report the same distance.",
        "Both sides are scaled by the estimate.",
        "Optional: check tyre pressures; `wheels.left_scale` and `wheels.right_scale` set known scales.",
    ),
    "side_scale_differs": Explanation(
        "warning",
        "One side goes less far than the other where both report the same distance, and nothing is corrected.",
        "The wheels veer: headings by wheels alone drift.",
        "Check wheel radii and tyre pressures, or leave `wheels.left_scale` and `wheels.right_scale` on auto.",
    ),
    "sides_swapped": Explanation(
        "info",
        "Left and right wheels are exchanged.",
        "They are exchanged back, except with preset `paper`.",
        "Correct the names of the joints or topics, or set `wheels.left_joints` and `wheels.right_joints`.",
    ),
    "side_reversed": Explanation(
        "info",
        "The wheels of a side count backwards.",
        "The sign is changed, except with preset `paper`.",
        "Correct the driver, or set a negative `wheels.left_scale` or `wheels.right_scale`.",
    ),
    "sides_ambiguous": Explanation(
        "warning",
        "Another assignment of sides and signs explains the log as well.",
        "The sides as named are used; if the names are wrong, the ICRs are wrong.",
        "Check the names of the wheels. Drive turns to both sides.",
    ),
}
"""Codes of findings about wheels."""

OF_POSITIONS: dict[str, Explanation] = {
    "positions_interpolated": Explanation(
        "warning",
        "The positions lie on straight lines between nodes, even where the robot turns: a program interpolated them.",
        "The nodes alone are used; the reference is unknown between them.",
        "Record the positions as they are measured, or more nodes.",
    ),
    "first_fixes_apart": Explanation(
        "warning",
        "The first fixes lie further from the others than the robot can drive.",
        "They are left out.",
        "Start to record when the receiver has a fix.",
    ),
    "reference_chosen": Explanation(
        "info",
        "Another position reference agrees better with wheels and heading than the topic chosen first.",
        "The reference that agrees better is used.",
        "`topics.gnss` sets the topic.",
    ),
    "fixes_frozen": Explanation(
        "warning",
        "Fixes repeat the one before to the last digit while the wheels go on.",
        "The repeated fixes are left out.",
        "Check the driver of the receiver: it sends old fixes while it has none.",
    ),
    "positions_mirrored": Explanation(
        "info",
        "The positions turn in the opposite sense to the robot: two of their axes, or the sign of one, are exchanged.",
        "They are exchanged back, except with preset `paper`.",
        "Correct the frame of the position reference, or the order and signs of latitude and longitude. Without a "
        "heading, check that the gyro is not upside down and the sides are not exchanged, which looks the same.",
    ),
    "gnss_float_as_fixed": Explanation(
        "warning",
        "Fixes that the receiver states as RTK fixed scatter or jump like RTK float.",
        "They get the larger variance of a float fix, except with preset `paper`.",
        "Check corrections and antenna of the receiver.",
    ),
    "gnss_not_fixed": Explanation(
        "info",
        "Some fixes are not RTK fixed while most of the log is.",
        "They get the variance of their class.",
        "Optional: check the corrections if there are many.",
    ),
    "gnss_noise_raised": Explanation(
        "info",
        "Positions scatter by more than they state.",
        "The measured scatter is used as their noise.",
        "Nothing. `filter.gnss_std_m` states a known noise.",
    ),
    "fixes_rejected": Explanation(
        "warning",
        "More than 10 % of the fixes contradict the filter.",
        "They are not used.",
        "Check clocks, GNSS quality and `frames.reference_delay_s`.",
    ),
    "antenna_forward_unknown": Explanation(
        "info",
        "The log does not state where the antenna is.",
        "x_icr is counted from the antenna.",
        "Set `frames.antenna_forward_m`, or record `/tf_static`.",
    ),
    "antenna_aside_unknown": Explanation(
        "warning",
        "Both ICRs lie to one side of the antenna, and the log does not state where it is.",
        "An antenna off the centre line and sides that slip unequally look the same: y_icr may be shifted.",
        "Measure the position of the antenna; set `frames.antenna_right_m` and `frames.antenna_forward_m`.",
    ),
    "lever_unknown": Explanation(
        "info",
        "It is not known where on the robot the position is measured.",
        "Row `controller` uses the position of the sensor that this log shows.",
        "Set `frames.antenna_forward_m` and `frames.antenna_right_m`.",
    ),
}
"""Codes of findings about positions."""

OF_HEADINGS: dict[str, Explanation] = {
    "heading_mounting": Explanation(
        "info",
        "The heading sensor is mounted on its side, or writes its quaternion in another order.",
        "The axis or order that fits is used; the offset is estimated.",
        "Optional: correct the driver or the mounting.",
    ),
    "heading_unusable": Explanation(
        "info",
        "A topic that could give the heading has no usable value.",
        "The heading is estimated from gyro, wheels and positions.",
        "Check the driver, if a heading was expected. `topics.heading` chooses a topic.",
    ),
    "heading_left_out": Explanation(
        "info",
        "The heading drifts, or is a course over ground, which turns about when the robot drives backwards.",
        "Only its turn rates are used, or nothing of it.",
        "Record an orientation that does not drift. `topics.heading` chooses a topic.",
    ),
    "heading_estimated": Explanation(
        "info",
        "No stated heading is used.",
        "The heading is estimated from the named sensors, with the stated standard deviation.",
        "Nothing. A heading of two antennas is more precise.",
    ),
    "heading_convention_corrected": Explanation(
        "info",
        "The heading turns in the opposite sense to the course over ground: it is ENU in place of NED, or reverse.",
        "The convention is changed.",
        "Set `frames.heading` to state it.",
    ),
    "heading_mirrored": Explanation(
        "info",
        "Heading and positions of the same poses are mirrored.",
        "Both are mirrored back.",
        "Set `frames.heading` to state the convention.",
    ),
    "heading_convention_contradicts": Explanation(
        "warning",
        "The heading turns in the opposite sense to the course over ground, and the configured convention is kept.",
        "The filter cannot follow: the numbers are wrong.",
        "Set `frames.heading` to the other of `enu` and `ned`.",
    ),
    "heading_offset_corrected": Explanation(
        "info",
        "The heading differs from the course over ground by a constant angle: mounting, magnetic declination, grid.",
        "The angle is subtracted.",
        "Nothing. `frames.heading_offset_deg` sets a known angle.",
    ),
    "heading_offset_differs": Explanation(
        "warning",
        "The heading differs from the course over ground, and the configuration or the preset keeps it.",
        "Paths turn away by that angle.",
        "Set `frames.heading_offset_deg` to auto or to the angle found.",
    ),
    "heading_scatters": Explanation(
        "warning",
        "The heading scatters about the course over ground.",
        "Its noise is raised to the measured scatter.",
        "Keep magnetometers away from motors; use a heading of two antennas.",
    ),
    "headings_rejected": Explanation(
        "warning",
        "More than 10 % of the headings contradict the filter.",
        "They are not used.",
        "Check clocks, the heading sensor and `frames.heading_delay_s`.",
    ),
    "gyro_sign_changed": Explanation(
        "info",
        "A measured heading or gyro counts turns in the other direction.",
        "Its sign is changed in the comparison of models.",
        "Optional: check how the sensor is mounted.",
    ),
    "gyro_not_used": Explanation(
        "info",
        "There is no gyro or measured heading that turns with the robot.",
        "Rows and models with a gyro are left out.",
        "Record an IMU, and check its mounting.",
    ),
}
"""Codes of findings about headings."""
