-- One row per gap between two successive messages of one sender that is longer than so many seconds.
--
-- drive: its name, which is its subset
-- seconds: longest time between two messages that is no gap; at 10 Hz messages are 0.1 s apart
--
-- dataset, subset, vehicle_id
-- from_s, until_s: when the messages before and after the gap were generated
-- gap_s: time between them
-- lost: messages missing by the sender's counter
-- clock_step_s: jump of the sender's clock in the gap; null = none
-- id_changed: whether the sender has another temporary id after it
CREATE MACRO message_gaps(drive, seconds) AS TABLE
SELECT
    sent.dataset,
    sent.subset,
    sent.vehicle_id,
    sent.before_s AS from_s,
    sent.time_s AS until_s,
    round(sent.time_s - sent.before_s, 6) AS gap_s,
    sent.lost_before AS lost,
    sent.clock_step_s,
    sent.temporary_id <> sent.id_before AS id_changed
FROM (
    SELECT
        message.dataset,
        message.subset,
        message.vehicle_id,
        message.time_s,
        message.lost_before,
        message.clock_step_s,
        message.temporary_id,
        asked.seconds_asked,
        lag(message.time_s) OVER station AS before_s,
        lag(message.temporary_id) OVER station AS id_before
    FROM (SELECT drive AS drive_asked, CAST(seconds AS DOUBLE) AS seconds_asked) AS asked
    JOIN (SELECT * FROM main.bsm AS message WHERE message.subset = drive) AS message
        ON message.subset = asked.drive_asked
    WINDOW station AS (
        PARTITION BY asked.seconds_asked, message.dataset, message.subset, message.vehicle_id ORDER BY message.time_s
    )
) AS sent
WHERE round(sent.time_s - sent.before_s, 6) > sent.seconds_asked
ORDER BY sent.dataset, sent.vehicle_id, sent.time_s
