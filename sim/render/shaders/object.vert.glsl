#version 330
// The visuals, one instance per primitive. Poses come row by row, hence vector * matrix.

uniform mat4 view;       // world to clip, rows
uniform mat4 lamp;       // world to the lamp's clip space, rows
uniform vec3 to_lamp;    // unit vector

in vec3 in_corner;
in vec3 in_normal;
in vec3 in_scale;
in vec3 in_rgb;
in mat4 in_pose;

out vec3 rgb;
out float facing;        // cosine between the surface and the lamp
out vec3 lamp_place;     // where to look in the lamp's shadow map

void main() {
    vec4 world = vec4(in_corner * in_scale, 1.0) * in_pose;
    vec3 normal = normalize((vec4(in_normal / in_scale, 0.0) * in_pose).xyz);
    rgb = in_rgb;
    facing = dot(normal, to_lamp);
    // Off the surface by a little more than a texel, so that it does not shade itself.
    vec4 shade_at = world + vec4(normal * 0.012, 0.0);
    lamp_place = (shade_at * lamp).xyz * 0.5 + 0.5;
    gl_Position = world * view;
}
