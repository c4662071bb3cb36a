#version 330
// Flat faces that no shadow reaches: one shade for each face.

uniform mat4 view;       // world to clip, rows
uniform vec3 to_lamp;    // unit vector
uniform vec3 ambient;    // with the lamp's tint
uniform vec3 diffuse;

in vec3 in_corner;
in vec3 in_normal;
in vec3 in_scale;
in vec3 in_rgb;
in mat4 in_pose;

flat out vec3 shade;

void main() {
    vec3 normal = normalize((vec4(in_normal / in_scale, 0.0) * in_pose).xyz);
    shade = in_rgb * (ambient + diffuse * max(dot(normal, to_lamp), 0.0));
    gl_Position = (vec4(in_corner * in_scale, 1.0) * in_pose) * view;
}
