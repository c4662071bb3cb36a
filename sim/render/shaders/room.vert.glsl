#version 330
// The room: a box seen from inside, its floor at z = 0. One instance.

uniform mat4 view;       // world to clip, rows
uniform mat4 lamp;       // world to the lamp's clip space, rows

in vec3 in_corner;
in vec3 in_normal;
in vec3 in_scale;
in mat4 in_pose;

out vec3 place;
flat out vec3 normal;    // into the room
out vec3 lamp_place;

void main() {
    vec4 world = vec4(in_corner * in_scale, 1.0) * in_pose;
    place = world.xyz;
    normal = in_normal;
    lamp_place = (world * lamp).xyz * 0.5 + 0.5;
    lamp_place.z = min(lamp_place.z, 1.0);  // beyond the map all is lit
    gl_Position = world * view;
}
