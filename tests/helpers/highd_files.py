"""Writes a highD recording's three files by hand, in the format as shipped."""

from raw_texts import write

META_HEADER = (
    "id,frameRate,locationId,speedLimit,month,weekDay,startTime,duration,totalDrivenDistance,totalDrivenTime,"
    "numVehicles,numCars,numTrucks,upperLaneMarkings,lowerLaneMarkings"
)
VEHICLES_HEADER = (
    "id,width,height,initialFrame,finalFrame,numFrames,class,drivingDirection,traveledDistance,minXVelocity,"
    "maxXVelocity,meanXVelocity,minDHW,minTHW,minTTC,numLaneChanges"
)
TRACKS_HEADER = (
    "frame,id,x,y,width,height,xVelocity,yVelocity,xAcceleration,yAcceleration,frontSightDistance,backSightDistance,"
    "dhw,thw,ttc,precedingXVelocity,precedingId,followingId,leftPrecedingId,leftAlongsideId,leftFollowingId,"
    "rightPrecedingId,rightAlongsideId,rightFollowingId,laneId"
)


def meta_row(number=1, *, rate=25, duration="9.015600e+02", vehicles=4, upper="8;12;16", lower="20;24;28"):
    return f"{number},{rate},3,-1.00,09.2017,Tue,08:38,{duration},1000.00,100.00,{vehicles},3,1,{upper},{lower}"


def vehicle_row(vehicle, length, width, frames, direction, kind="Car"):
    return f"{vehicle},{length},{width},1,{frames},{frames},{kind},{direction},1.00,25,25,25,-1.00,-1.00,-1.00,0"


def track_row(frame, vehicle, box, velocity, lane, *, acceleration=0, dhw=0, leader=0, follower=0):
    """`box` is x, y, width, height of the image; `velocity` x and y."""
    x, y, width, height = box
    return (
        f"{frame},{vehicle},{x},{y},{width},{height},{velocity[0]},{velocity[1]},{acceleration},0.00,10,10,"
        f"{dhw},0.00,0.00,0.00,{leader},{follower},0,0,0,0,0,0,{lane}"
    )


VEHICLES = [vehicle_row(1, 4, 2, 2, 1), vehicle_row(2, 5, 2, 2, 1), vehicle_row(3, 4, 2, 2, 2),
            vehicle_row(4, 12, 2.5, 1, 2, "Truck")]  # fmt: skip
TRACKS = [
    # The upper carriageway drives to the left: 2 is 40 m ahead of 1, in the lane beside the median.
    track_row(1, 1, (100, 13, 4, 2), ("-25.00", "0.20"), 3, acceleration="0.50", dhw="35.00", leader=2),
    track_row(2, 1, (99, 13, 4, 2), ("-25.00", "0.00"), 3, leader=2, dhw="35.00"),
    track_row(1, 2, (60, 13, 5, 2), ("-25.00", "0.00"), 3, follower=1),
    track_row(2, 2, (59, 9, 5, 2), ("1.00", "0.00"), 2, follower=1),
    # The lower one drives to the right: the truck 4 is ahead of 3 in the right lane, and gone in frame 2.
    track_row(1, 3, (10, 21, 4, 2), ("25.00", "0.20"), 5, acceleration="-0.50", dhw="36.00", leader=4),
    track_row(2, 3, (11, 21, 4, 2), ("25.00", "-0.20"), 5, dhw="35.00", leader=4),
    track_row(1, 4, (50, 25, 12, 2.5), ("20.00", "0.00"), 6, follower=3),
]


def write_recording(folder, *, meta=None, vehicles=VEHICLES, tracks=TRACKS, number="01", end="\n"):
    """The paths of the three files; `meta` is the line under the header, or lines."""
    lines = [meta_row(int(number))] if meta is None else [meta] if isinstance(meta, str) else meta
    return [
        write(folder / f"{number}_{kind}.csv", (end.join([header, *rows]) + end).encode())
        for kind, header, rows in (
            ("recordingMeta", META_HEADER, lines),
            ("tracksMeta", VEHICLES_HEADER, vehicles),
            ("tracks", TRACKS_HEADER, tracks),
        )
    ]
