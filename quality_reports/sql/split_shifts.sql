-- Per split, dataset, pair of parts and quantity: how the distributions differ.
-- $parts, $quantities: their names in order.
SELECT split, dataset, part, other_part, quantity, mean, other_mean, std, other_std, shift
FROM split_shifts
ORDER BY
    split, dataset, list_position($parts::VARCHAR[], part), list_position($parts::VARCHAR[], other_part),
    list_position($quantities::VARCHAR[], quantity)
