"""Collective perception messages (CPM) as ROS 2 messages of `etsi_its_cpm_ts_msgs`, whose node encodes them for radio.

The definitions have the names, types and order of its version 3 for ETSI TS 103 324 V2.1.1: a number is a type with
`value`, a list one with `array`, and an optional field is followed by `<field>_is_present`.
"""

from collections.abc import Iterator, Mapping
from typing import Any, Final

__all__ = ["CPM", "PACKAGE", "cpm_fields", "definitions"]

PACKAGE: Final = "etsi_its_cpm_ts_msgs/msg"
CPM: Final = f"{PACKAGE}/CollectivePerceptionMessage"
MESSAGE_ID: Final = 14
_SENSORS, _OBJECTS = 3, 5  # ids of containers
_MOST: Final = 255  # of a count

_NUMBERS: Final = {
    "uint8": "AccelerationConfidence AccelerationMagnitudeValue AltitudeConfidence AngleConfidence"
    " AngularSpeedConfidence CardinalNumber1B CardinalNumber3b ConfidenceLevel CpmContainerId Identifier1B MessageId"
    " ObjectDimensionConfidence ObjectPerceptionQuality OrdinalNumber1B OrdinalNumber3b OtherSubClass SensorType"
    " SpeedConfidence StandardLength1B TrafficParticipantType VehicleWidth VruSubProfileAnimal VruSubProfileBicyclist"
    " VruSubProfileMotorcyclist VruSubProfilePedestrian Wgs84AngleConfidence",
    "int8": "CorrelationCellValue",
    "uint16": "CartesianAngleValue CoordinateConfidence HeadingValue Identifier2B LongitudinalLanePositionConfidence"
    " LongitudinalLanePositionValue ObjectDimensionValue SemiAxisLength SpeedValue StandardLength12b Wgs84AngleValue",
    "int16": "AccelerationValue CartesianAngularVelocityComponentValue CartesianCoordinate CartesianCoordinateSmall"
    " DeltaTimeMilliSecondSigned VelocityComponentValue",
    "uint32": "StationId",
    "int32": "AltitudeValue CartesianCoordinateLarge Latitude Longitude",
    "uint64": "TimestampIts",
}
_LISTS: Final = {
    "CorrelationColumn": "CorrelationCellValue",
    "LowerTriangularPositiveSemidefiniteMatrices": "LowerTriangularPositiveSemidefiniteMatrix",
    "LowerTriangularPositiveSemidefiniteMatrixColumns": "CorrelationColumn",
    "ObjectClassDescription": "ObjectClassWithConfidence",
    "PerceivedObjectIds": "Identifier2B",
    "PerceivedObjects": "PerceivedObject",
    "PerceptionRegionContainer": "PerceptionRegion",
    "RadialShapesList": "RadialShapeDetails",
    "SensorInformationContainer": "SensorInformation",
    "SequenceOfCartesianPosition3d": "CartesianPosition3d",
    "SequenceOfIdentifier1B": "Identifier1B",
    "TrailerDataSet": "TrailerData",
    "WrappedCpmContainers": "WrappedCpmContainer",
}
_FIELDS: Final = """
Acceleration3dWithConfidence | AccelerationPolarWithZ polar_acceleration, AccelerationCartesian cartesian_acceleration
AccelerationCartesian: AccelerationComponent x_acceleration, AccelerationComponent y_acceleration, \
AccelerationComponent z_acceleration?
AccelerationComponent: AccelerationValue value, AccelerationConfidence confidence
AccelerationMagnitude: AccelerationMagnitudeValue acceleration_magnitude_value, \
AccelerationConfidence acceleration_confidence
AccelerationPolarWithZ: AccelerationMagnitude acceleration_magnitude, CartesianAngle acceleration_direction, \
AccelerationComponent z_acceleration?
Altitude: AltitudeValue altitude_value, AltitudeConfidence altitude_confidence
CartesianAngle: CartesianAngleValue value, AngleConfidence confidence
CartesianAngularVelocityComponent: CartesianAngularVelocityComponentValue value, AngularSpeedConfidence confidence
CartesianCoordinateWithConfidence: CartesianCoordinateLarge value, CoordinateConfidence confidence
CartesianPosition3d: CartesianCoordinate x_coordinate, CartesianCoordinate y_coordinate, \
CartesianCoordinate z_coordinate?
CartesianPosition3dWithConfidence: CartesianCoordinateWithConfidence x_coordinate, \
CartesianCoordinateWithConfidence y_coordinate, CartesianCoordinateWithConfidence z_coordinate?
CircularShape: CartesianPosition3d shape_reference_point?, StandardLength12b radius, StandardLength12b height?
CollectivePerceptionMessage: ItsPduHeader header, CpmPayload payload
ConstraintWrappedCpmContainers: WrappedCpmContainers value
CpmPayload: ManagementContainer management_container, ConstraintWrappedCpmContainers cpm_containers
EllipticalShape: CartesianPosition3d shape_reference_point?, StandardLength12b semi_major_axis_length, \
StandardLength12b semi_minor_axis_length, Wgs84AngleValue orientation?, StandardLength12b height?
EulerAnglesWithConfidence: CartesianAngle z_angle, CartesianAngle y_angle?, CartesianAngle x_angle?
IntersectionReferenceId: Identifier2B region?, Identifier2B id
ItsPduHeader: OrdinalNumber1B protocol_version, MessageId message_id, StationId station_id
LongitudinalLanePosition: LongitudinalLanePositionValue longitudinal_lane_position_value, \
LongitudinalLanePositionConfidence longitudinal_lane_position_confidence
LowerTriangularPositiveSemidefiniteMatrix: MatrixIncludedComponents components_included_inthe_matrix, \
LowerTriangularPositiveSemidefiniteMatrixColumns matrix
ManagementContainer: TimestampIts reference_time, ReferencePosition reference_position, \
MessageSegmentationInfo segmentation_info?, MessageRateRange message_rate_range?
MapPosition: MapReference map_reference?, Identifier1B lane_id?, Identifier1B connection_id?, \
LongitudinalLanePosition longitudinal_lane_position?
MapReference | RoadSegmentReferenceId roadsegment, IntersectionReferenceId intersection
MatrixIncludedComponents: uint8[] value, uint8 bits_unused
MessageRateHz: uint8 mantissa, int8 exponent
MessageRateRange: MessageRateHz message_rate_min, MessageRateHz message_rate_max
MessageSegmentationInfo: CardinalNumber3b total_msg_no, OrdinalNumber3b this_msg_no
ObjectClass | TrafficParticipantType vehicle_sub_class, VruProfileAndSubprofile vru_sub_class, \
VruClusterInformation group_sub_class, OtherSubClass other_sub_class
ObjectClassWithConfidence: ObjectClass object_class, ConfidenceLevel confidence
ObjectDimension: ObjectDimensionValue value, ObjectDimensionConfidence confidence
OriginatingRsuContainer: MapReference map_reference?
OriginatingVehicleContainer: Wgs84Angle orientation_angle, CartesianAngle pitch_angle?, CartesianAngle roll_angle?, \
TrailerDataSet trailer_data_set?
PerceivedObject: Identifier2B object_id?, DeltaTimeMilliSecondSigned measurement_delta_time, \
CartesianPosition3dWithConfidence position, Velocity3dWithConfidence velocity?, \
Acceleration3dWithConfidence acceleration?, EulerAnglesWithConfidence angles?, \
CartesianAngularVelocityComponent z_angular_velocity?, \
LowerTriangularPositiveSemidefiniteMatrices lower_triangular_correlation_matrices?, \
ObjectDimension object_dimension_z?, ObjectDimension object_dimension_y?, ObjectDimension object_dimension_x?, \
DeltaTimeMilliSecondSigned object_age?, ObjectPerceptionQuality object_perception_quality?, \
SequenceOfIdentifier1B sensor_id_list?, ObjectClassDescription classification?, MapPosition map_position?
PerceivedObjectContainer: CardinalNumber1B number_of_perceived_objects, PerceivedObjects perceived_objects
PerceptionRegion: DeltaTimeMilliSecondSigned measurement_delta_time, ConfidenceLevel perception_region_confidence, \
Shape perception_region_shape, bool shadowing_applies, SequenceOfIdentifier1B sensor_id_list?, \
CardinalNumber1B number_of_perceived_objects?, PerceivedObjectIds perceived_object_ids?
PolygonalShape: CartesianPosition3d shape_reference_point?, SequenceOfCartesianPosition3d polygon, \
StandardLength12b height?
PosConfidenceEllipse: SemiAxisLength semi_major_confidence, SemiAxisLength semi_minor_confidence, \
HeadingValue semi_major_orientation
RadialShape: CartesianPosition3d shape_reference_point?, StandardLength12b range, \
Wgs84AngleValue stationary_horizontal_opening_angle_start, Wgs84AngleValue stationary_horizontal_opening_angle_end, \
CartesianAngleValue vertical_opening_angle_start?, CartesianAngleValue vertical_opening_angle_end?
RadialShapeDetails: StandardLength12b range, CartesianAngleValue horizontal_opening_angle_start, \
CartesianAngleValue horizontal_opening_angle_end, CartesianAngleValue vertical_opening_angle_start?, \
CartesianAngleValue vertical_opening_angle_end?
RadialShapes: Identifier1B ref_point_id, CartesianCoordinateSmall x_coordinate, \
CartesianCoordinateSmall y_coordinate, CartesianCoordinateSmall z_coordinate?, RadialShapesList radial_shapes_list
RectangularShape: CartesianPosition3d center_point?, StandardLength12b semi_length, StandardLength12b semi_breadth, \
Wgs84AngleValue orientation?, StandardLength12b height?
ReferencePosition: Latitude latitude, Longitude longitude, PosConfidenceEllipse position_confidence_ellipse, \
Altitude altitude
RoadSegmentReferenceId: Identifier2B region?, Identifier2B id
SensorInformation: Identifier1B sensor_id, SensorType sensor_type, Shape perception_region_shape?, \
ConfidenceLevel perception_region_confidence?, bool shadowing_applies
Shape | RectangularShape rectangular, CircularShape circular, PolygonalShape polygonal, EllipticalShape elliptical, \
RadialShape radial, RadialShapes radial_shapes
Speed: SpeedValue speed_value, SpeedConfidence speed_confidence
TrailerData: Identifier1B ref_point_id, StandardLength1B hitch_point_offset, StandardLength1B front_overhang?, \
StandardLength1B rear_overhang?, VehicleWidth trailer_width?, CartesianAngle hitch_angle
Velocity3dWithConfidence | VelocityPolarWithZ polar_velocity, VelocityCartesian cartesian_velocity
VelocityCartesian: VelocityComponent x_velocity, VelocityComponent y_velocity, VelocityComponent z_velocity?
VelocityComponent: VelocityComponentValue value, SpeedConfidence confidence
VelocityPolarWithZ: Speed velocity_magnitude, CartesianAngle velocity_direction, VelocityComponent z_velocity?
VruClusterInformation: Identifier1B cluster_id?, Shape cluster_bounding_box_shape?, \
CardinalNumber1B cluster_cardinality_size, VruClusterProfiles cluster_profiles?
VruClusterProfiles: uint8[] value, uint8 bits_unused
VruProfileAndSubprofile | VruSubProfilePedestrian pedestrian, \
VruSubProfileBicyclist bicyclist_and_light_vru_vehicle, VruSubProfileMotorcyclist motorcyclist, \
VruSubProfileAnimal animal
Wgs84Angle: Wgs84AngleValue value, Wgs84AngleConfidence confidence
WrappedCpmContainer: CpmContainerId container_id, \
OriginatingVehicleContainer container_data_originating_vehicle_container, \
OriginatingRsuContainer container_data_originating_rsu_container, \
SensorInformationContainer container_data_sensor_information_container, \
PerceptionRegionContainer container_data_perception_region_container, \
PerceivedObjectContainer container_data_perceived_object_container
"""
"""Types with fields, `?` after optional ones; a bar stands for `choice`, the number of the one field that counts."""

_JSON: Final = {
    "altitude_value": "value",
    "altitude_confidence": "confidence",
    "semi_major_confidence": "semi_major",
    "semi_minor_confidence": "semi_minor",
    "vehicle_sub_class": "vehicle",
    "vru_sub_class": "vru",
    "other_sub_class": "other",
    "motorcyclist": "motorcylist",
}
"""Names of fields in JSON that differ."""


def _parsed() -> dict[str, tuple[bool, list[list[str]]]]:
    """Return types with fields: whether they are a choice, and type and name of each field."""
    found = {}
    for line in _FIELDS.strip().splitlines():
        choice = " | " in line
        kind, _, fields = line.partition(" | " if choice else ": ")
        found[kind] = choice, [one.split() for one in fields.split(", ")]
    return found


_TYPES: Final = _parsed()


def definitions() -> Iterator[tuple[str, str]]:
    """Yield each type of the package with the text of its definition."""
    for number, kinds in _NUMBERS.items():
        yield from ((kind, f"{number} value") for kind in kinds.split())
    yield from ((kind, f"{item}[] array") for kind, item in _LISTS.items())
    for kind, (choice, fields) in _TYPES.items():
        lines = ["uint8 choice"] if choice else []
        for of, name in fields:
            bare = name.rstrip("?")
            lines += [f"{of} {bare}", *([f"bool {bare}_is_present"] if bare != name else [])]
        yield kind, "\n".join(lines)


def cpm_fields(message: Mapping[str, Any], perceived: int) -> dict[str, Any]:
    """Return the fields of a `CollectivePerceptionMessage` from the `message` of its JSON form.

    Args:
        message: with the names of JSON.
        perceived: objects that the station perceives now, also those that are not in the message.
    """
    containers: list[dict[str, Any]] = []
    if sensors := message.get("sensor_information_container"):
        containers.append({"container_id": _SENSORS, "container_data_sensor_information_container": sensors})
    if objects := message.get("perceived_object_container"):
        one = {"number_of_perceived_objects": min(perceived, _MOST), "perceived_objects": objects}
        containers.append({"container_id": _OBJECTS, "container_data_perceived_object_container": one})
    payload = {"management_container": message["management_container"], "cpm_containers": {"value": containers}}
    whole = {"header": {"message_id": MESSAGE_ID, **message}, "payload": payload}
    filled: dict[str, Any] = _filled("CollectivePerceptionMessage", whole)
    return filled


def _filled(kind: str, value: Any) -> Any:
    """Return a value as fields of a type."""
    if kind in _LISTS:
        return {"array": [_filled(_LISTS[kind], one) for one in value]}
    if kind not in _TYPES:
        return value if kind[0].islower() else {"value": value}
    choice, fields = _TYPES[kind]
    filled: dict[str, Any] = {}
    for number, (of, name) in enumerate(fields):
        bare = name.rstrip("?")
        one = value.get(_JSON.get(bare, bare))
        if one is not None:
            filled[bare] = _filled(of, one)
            filled |= {"choice": number} if choice else {f"{bare}_is_present": True} if bare != name else {}
    return filled
