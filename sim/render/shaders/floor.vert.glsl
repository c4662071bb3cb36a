#version 330
// The floor, z = 0.

uniform mat4 view;       // world to clip, rows
uniform mat4 lamp;       // world to the lamp's clip space, rows

in vec3 in_corner;
in vec3 in_scale;
in mat4 in_pose;

out vec2 place;
out vec3 lamp_place;

void main() {
    vec4 world = vec4(in_corner * in_scale, 1.0) * in_pose;
    place = world.xy;
    lamp_place = (world * lamp).xyz * 0.5 + 0.5;
    gl_Position = world * view;
}
