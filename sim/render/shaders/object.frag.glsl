#version 330
// Lambert reflection: ambient light, and the lamp where it is not blocked.

uniform vec3 ambient;    // with the lamp's tint
uniform vec3 diffuse;
uniform sampler2DShadow lamp_map;

in vec3 rgb;
in float facing;
in vec3 lamp_place;

out vec4 colour;

void main() {
    float lit = facing > 0.0 ? facing * texture(lamp_map, vec3(lamp_place.xy, min(lamp_place.z, 1.0))) : 0.0;
    colour = vec4(rgb * (ambient + diffuse * lit), 1.0);
}
